"""Acquisition: one thread for each device, and the main loop that feeds the pipeline."""
