"""Samples and results of recordings in the formats of other programs."""
