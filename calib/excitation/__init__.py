"""Detection of motion and rest, windows of known excitation, and the sums of their samples."""
