"""`fieldcal bench`: leads a person through positions to a wanted uncertainty, and ends with the result."""
