"""Decodes lines of comma-separated decimal numbers and reports every line that is not one."""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.block import LARGEST

MAX_LINE_BYTES = 256  # bytes with the newline; the four longest decimals of a line have 220 bytes
# float() also accepts nan, inf and 1_000, which are not indications. The repeat counts limit the length of a line and
# still accept the repr() of any double.
_DECIMAL = rb"[ \t]{0,4}[+-]?(?:\d{1,16}(?:\.\d{0,24})?|\.\d{1,24})(?:[eE][+-]?\d{1,3})?[ \t]{0,4}"


@dataclass(frozen=True, slots=True, eq=False)
class Decoded:
    """Result of `decode`: `line` (N,) numbers of the good lines, counted from 0; `values` (N, columns)."""

    line: NDArray[np.int64]
    values: NDArray[np.float64]
    bad_at: list[int]  # numbers of the bad lines, overlong lines included, in ascending order
    bad_lines: int  # number of bad lines without the overlong ones
    bad_bytes: int  # number of bytes in overlong lines


@functools.cache
def _pattern(columns: int) -> re.Pattern[bytes]:
    return re.compile(rb",".join([_DECIMAL] * columns) + rb"\r?")


def decode(text: bytes, columns: int) -> Decoded:
    """Decode complete lines, each ended by LF or CRLF, with `columns` decimal numbers each.

    Blank lines and comments (#) are skipped. A line is bad if it has another number of fields, a field that is not a
    decimal number, or a value beyond LARGEST. Takes about 1.5 us per line, good or bad, on a desktop core.
    """
    lines = text.split(b"\n")[:-1]
    is_good = _pattern(columns).fullmatch
    shaped = [number for number, line in enumerate(lines) if is_good(line)]
    fields = b",".join([lines[number] for number in shaped]).split(b",") if shaped else []
    values = np.array(list(map(float, fields))).reshape(-1, columns)
    sound = (np.abs(values) <= LARGEST).all(axis=1)
    line = np.array(shaped, np.int64)[sound]
    others = sorted(set(range(len(lines))).difference(line.tolist())) if len(line) < len(lines) else []
    bad_at = [number for number in others if not _ignored(lines[number])]
    overlong = [len(lines[number]) + 1 for number in bad_at if _overlong(lines[number])]
    return Decoded(line, values[sound], bad_at, len(bad_at) - len(overlong), sum(overlong))


def _ignored(line: bytes) -> bool:
    text = line.strip()
    return not text or (text.startswith(b"#") and not _overlong(line))


def _overlong(line: bytes) -> bool:
    return len(line) >= MAX_LINE_BYTES
