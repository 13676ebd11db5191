"""`fieldcal bench` and `fieldcal visit`: lead a person through positions, or with a reference from sensor to sensor."""
