"""Devices read by threads, and the one loop that feeds the pipeline."""
