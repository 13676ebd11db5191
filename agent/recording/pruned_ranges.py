"""The numbers of all recordings that retention ever deleted, as every later recording repeats them.

The event Pruned says it once, in a recording that will be deleted too.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

PRUNED_METADATA = "fieldcal.pruned"
_RANGE = re.compile(r"(\d{1,18})-(\d{1,18})")

Ranges = tuple[tuple[int, int], ...]
"""(first, last), rising, with at least one number between two."""


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
    """As an MCAP metadata record of the name PRUNED_METADATA."""
    return {"recordings": ",".join(f"{first}-{last}" for first, last in ranges)}


def from_metadata(metadata: dict[str, str] | None) -> Ranges:
    """Empty where the record is not there; what is no range in it is left out."""
    matches = map(_RANGE.fullmatch, (metadata or {}).get("recordings", "").split(","))
    return merged((int(match[1]), int(match[2])) for match in matches if match and int(match[1]) <= int(match[2]))


def first_outside(ranges: Ranges, first: int, last: int) -> tuple[int, int] | None:
    """The first run of numbers from `first` to `last` that is in none of the ranges; None where all are."""
    for begin, end in ranges:
        if begin > first:
            return (first, min(last, begin - 1)) if first <= last else None
        first = max(first, end + 1)
    return (first, last) if first <= last else None
