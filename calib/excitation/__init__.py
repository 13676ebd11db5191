"""Where a sensor moves or rests, windows of known excitation and their sums."""
