"""The audit: are recordings what the gateway wrote, and do their results follow from their data?"""
