"""Writes durations, sizes and counts for people."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """A duration as hours, minutes and seconds, or as days and hours."""
    whole = int(seconds)
    if whole >= 86400:
        return f"{whole // 86400} d {whole % 86400 // 3600:02d} h"
    return f"{whole // 3600:02d}:{whole % 3600 // 60:02d}:{whole % 60:02d}"


def counted(count: int, plural: str) -> str:
    """A number of things: 1 line, 2 lines."""
    return f"{count} {plural.removesuffix('s') if count == 1 else plural}"


def size(octets: int) -> str:
    """The size of a file in B, kB, MB, GB or TB."""
    value = float(octets)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000:
            return f"{value:.3g} {unit}" if unit != "B" else f"{octets} B"
        value /= 1000
    return f"{value:.3g} TB"
