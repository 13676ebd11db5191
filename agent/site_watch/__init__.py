"""The sensors of a site without a reference: their hourly results from files, days in binary, and what is told of
them.
"""
