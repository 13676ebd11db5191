"""The adjustment of files: S, Q and all nuisances from all windows at once. Begin with `adjustment.py`."""
