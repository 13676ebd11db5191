"""Devices: the sample block that every driver returns, the sensor protocol, the drivers and the virtual bench."""
