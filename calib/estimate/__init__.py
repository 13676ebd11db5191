"""S, Q and all nuisances from the records of windows and from statements: what files and streams share.

Begin with `estimate.py`. `physics.py` is V = S a + Q of a window, `quantities.py` the table of all unknowns.
"""
