"""Sample times, resampling, bands and filters."""
