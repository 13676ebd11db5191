"""Decodes lines of comma-separated decimals: fast where all lines are good, and exact about which are not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAX_LINE_BYTES = 256  # a line of four long decimals has about 100; more without a newline is no line
MAX_NUMBER_BYTES = 32  # repr of a double has at most 24 and leaves room for spaces
LARGEST = 1e12  # no unit of indication needs more, and squares and sums of it stay finite
_NUMBER_BYTES = b"0123456789+-.eE, \t\r\n"  # what float() takes besides (nan, inf, 1_000) is no indication
_COMMA, _NEWLINE = 44, 10


@dataclass(frozen=True, slots=True, eq=False)
class Decoded:
    """Good lines of a text: `line` (N,) their numbers counted from 0, `values` (N, columns). The rest, counted."""

    line: NDArray[np.int64]
    values: NDArray[np.float64]
    bad_at: list[int]  # numbers of the bad lines, overlong ones included, in rising order
    bad_lines: int  # that are not overlong
    bad_bytes: int  # of overlong lines


def decode(text: bytes, columns: int) -> Decoded:
    """Decode whole lines, each ended by a newline, of `columns` decimals.

    Blank lines and comments (#) count as nothing. A bad line (another number of fields, no decimals, not finite,
    beyond LARGEST) is found by halving the text, so that the rest still goes the fast way.
    """
    good: list[tuple[int, NDArray[np.float64]]] = []
    bad_at = []
    bad_lines = bad_bytes = 0
    todo = [(0, text)]
    while todo:
        first, part = todo.pop()
        values = _decode_all(part, columns)
        if values is not None:
            good.append((first, values))
            continue
        lines = part.count(b"\n")
        if lines > 1:
            middle = part.index(b"\n", len(part) // 2) + 1
            if middle == len(part):  # the last line alone is longer than half
                middle = part.rindex(b"\n", 0, len(part) - 1) + 1
            todo += [(first + part.count(b"\n", 0, middle), part[middle:]), (first, part[:middle])]
        elif len(part) > MAX_LINE_BYTES:
            bad_bytes += len(part)
            bad_at.append(first)
        elif part.strip() and not part.lstrip().startswith(b"#"):
            bad_lines += 1
            bad_at.append(first)
    if not good:
        return Decoded(np.empty(0, np.int64), np.empty((0, columns)), bad_at, bad_lines, bad_bytes)
    line = np.concatenate([np.arange(first, first + len(values)) for first, values in good])
    return Decoded(line, np.concatenate([values for _, values in good]), bad_at, bad_lines, bad_bytes)


def _decode_all(text: bytes, columns: int) -> NDArray[np.float64] | None:
    """(lines, columns) decimals, or None when any line is not as it should be."""
    if text.translate(None, _NUMBER_BYTES):
        return None
    raw = np.frombuffer(text, np.uint8)
    ends = np.flatnonzero((raw == _COMMA) | (raw == _NEWLINE))
    if len(ends) % columns or np.diff(ends, prepend=-1).max() > MAX_NUMBER_BYTES + 1:
        return None
    if not ((raw[ends].reshape(-1, columns) == _NEWLINE) == (np.arange(columns) == columns - 1)).all():
        return None
    try:
        values = np.array(list(map(float, text[:-1].replace(b"\n", b",").split(b",")))).reshape(-1, columns)
    except ValueError:
        return None
    return values if (np.abs(values) <= LARGEST).all() else None
