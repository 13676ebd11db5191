"""Readers of files with samples: one file for each format, and one table of them in agent/reading/formats.py."""
