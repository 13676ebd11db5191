"""Figures and one page of a calibration."""
