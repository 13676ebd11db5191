"""The deterministic core: events in, results out. No I/O, no clock, no threads, no randomness."""
