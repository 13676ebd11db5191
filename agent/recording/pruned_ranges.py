"""The numbers of all recordings that retention has deleted, in a metadata record that every later recording repeats.

The event Pruned names deleted recordings only once, and the recording that holds the event is itself deleted later.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

PRUNED_METADATA = "fieldcal.pruned"
_RANGE = re.compile(r"(\d{1,18})-(\d{1,18})")

Ranges = tuple[tuple[int, int], ...]
"""Ranges (first, last) of file numbers, both included, rising, with at least one number between two ranges."""


def merged(ranges: Iterable[tuple[int, int]]) -> Ranges:
    """The same numbers in the fewest ranges."""
    result: list[tuple[int, int]] = []
    for first, last in sorted(ranges):
        if result and first <= result[-1][1] + 1:
            result[-1] = (result[-1][0], max(last, result[-1][1]))
        else:
            result.append((first, last))
    return tuple(result)


def to_metadata(ranges: Ranges) -> dict[str, str]:
    """The ranges as the content of the MCAP metadata record named PRUNED_METADATA."""
    return {"recordings": ",".join(f"{first}-{last}" for first, last in ranges)}


def from_metadata(metadata: dict[str, str] | None) -> Ranges:
    """The ranges in such a metadata record; empty for None. Text in it that is not a range is ignored."""
    matches = map(_RANGE.fullmatch, (metadata or {}).get("recordings", "").split(","))
    return merged((int(match[1]), int(match[2])) for match in matches if match and int(match[1]) <= int(match[2]))


def first_outside(ranges: Ranges, first: int, last: int) -> tuple[int, int] | None:
    """The first run of numbers within `first` to `last` that is in none of the ranges; None where all numbers are."""
    for begin, end in ranges:
        if begin > first:
            return (first, min(last, begin - 1)) if first <= last else None
        first = max(first, end + 1)
    return (first, last) if first <= last else None
