"""The sensors of a site that have no reference, watched together: which one's sensitivity changes, and which change
is the structure's. docs/site-watch.md says how. Begin with `watch.py`."""
