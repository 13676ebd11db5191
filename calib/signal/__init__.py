"""Times of samples, resampling, frequency bands and filters."""
