"""Devices: the sample block every driver yields, the sensor protocol, the drivers and the virtual bench."""
