"""From recorded samples of a sensor and a reference to S and Q: what `fieldcal calibrate` and a notebook share."""
