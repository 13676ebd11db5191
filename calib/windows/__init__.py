"""What a window says of S and Q: sums of its samples, the regression on them, and the record that is kept of it.

Begin with `record.py`; `sums.py` and `bands.py` are what the front end makes.
"""
