"""Recordings (MCAP files): writing, reading, byte-by-byte checks, repair, signatures and comparison with a replay."""
