"""Tests whether a sensor has changed. Begin with `drift.py` (windows: steps and fast drifts).

`net_changes.py` tests S and Q over a week to four years, `mean_change.py` the mean output of a sensor without a
reference. The first two keep a stated number of false alarms a year (`false_alarms.py`).
"""
