"""Recordings: written, read back, checked byte by byte, and compared with what they give again."""
