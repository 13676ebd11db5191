"""Writes values with their uncertainties, durations and sizes for people."""

from __future__ import annotations

import math


def plus_minus(value: float | None, expanded: float | None) -> str:
    """`value ± U`, both rounded to the second digit of U; `–` if there is no value."""
    if value is None or not math.isfinite(value):
        return "–"
    if expanded is None or not math.isfinite(expanded) or expanded <= 0:
        return f"{value:.6g} ± ?"
    decimals = max(0, 1 - math.floor(math.log10(expanded)))
    return f"{value:.{decimals}f} ± {expanded:.{decimals}f}"


def duration(seconds: float) -> str:
    """A duration as hours, minutes and seconds, or as days and hours."""
    whole = int(seconds)
    if whole >= 86400:
        return f"{whole // 86400} d {whole % 86400 // 3600:02d} h"
    return f"{whole // 3600:02d}:{whole % 3600 // 60:02d}:{whole % 60:02d}"


def size(octets: int) -> str:
    """The size of a file in B, kB, MB, GB or TB."""
    value = float(octets)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000:
            return f"{value:.3g} {unit}" if unit != "B" else f"{octets} B"
        value /= 1000
    return f"{value:.3g} TB"
