"""Tests whether a sensor has changed, each with a stated rate of false alarms. Begin with `drift.py`."""
