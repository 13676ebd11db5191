"""From recorded samples of a sensor and a reference to S and Q: what files and a notebook share.

Begin with `calibrating.py`.
"""
