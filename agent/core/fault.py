"""Describes a fault of the program in one line, which is the same wherever the recording is replayed."""

from __future__ import annotations

import re

OURS = ("agent", "calib", "hw")
LONGEST = 200  # characters of the exception's message
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")  # address of an object in memory: it differs between processes


def description(error: Exception) -> str:
    """`ValueError at agent/core/windows.py:57: what it says`: the innermost line that belongs to this program."""
    place, trace = "an unknown place", error.__traceback__
    while trace is not None:
        module = str(trace.tb_frame.f_globals.get("__name__", ""))
        if module.partition(".")[0] in OURS:
            place = f"{module.replace('.', '/')}.py:{trace.tb_lineno}"
        trace = trace.tb_next
    said = _ADDRESS.sub("", " ".join(str(error).split()))[:LONGEST]
    return f"{type(error).__name__} at {place}" + (f": {said}" if said else "")
