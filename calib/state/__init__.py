"""The state of a sensor on-line: records and statements, and what follows from them for now and for the past.

Begin with `state.py`.
"""
