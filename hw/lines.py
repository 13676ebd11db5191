"""Decodes lines of decimal numbers and reports every line that is not one, with the reason.

Numbers are separated by commas, by semicolons, or by blanks and tabs: by one of the three in each line. A mixture is
refused, because it is what decimal commas look like ("1,5;2,3"). The separators are those of the Arduino Serial Plotter
(arduino/Arduino, build/shared/ArduinoSerialPlotterProtocol.md: blank, tab, comma) and the semicolon.
"""

from __future__ import annotations

import functools
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAX_LINE_BYTES = 256  # bytes with the newline; the four longest decimals of a line have 220 bytes
MOST_COLUMNS = 16
LARGEST_EXACT = 2.0**53  # up to here a float64 holds every whole number: enough for a time in us since 1970
UNREADABLE = "line without the expected decimal numbers"
OTHER_COLUMNS = "line with more or fewer numbers than the configuration names (columns, or axes and sequence)"
DECIMAL_COMMAS = "line with decimal commas: let the device write decimal points"
NAMED_NUMBERS = "line with names before its numbers: let the device write the numbers alone"

# float() also accepts nan, inf and 1_000, which are not indications. The repeat counts limit the length of a line and
# still accept the repr() of any double.
_DECIMAL = rb"[+-]?(?:\d{1,16}(?:\.\d{0,24})?|\.\d{1,24})(?:[eE][+-]?\d{1,3})?"
_ANYTHING = rb"[^\s,;#][^\s,;]{0,31}"
_BLANKS = rb"[ \t]{0,8}"
# Separator, and what may stand behind the last field
_SEPARATORS = (
    (_BLANKS + b"," + _BLANKS, _BLANKS + b",?"),
    (_BLANKS + b";" + _BLANKS, _BLANKS + b";?"),
    (rb"[ \t]{1,8}", b""),
)
_TO_BLANKS = bytes.maketrans(b",;\t", b"   ")
_WITH_COMMA = rb"[+-]?\d{1,16}(?:,\d{1,24})?"
_WITH_COMMAS = re.compile(_BLANKS + _WITH_COMMA + rb"(?:[; \t]{1,8}" + _WITH_COMMA + rb"){1,15}[; \t]{0,8}")
_NAMED = re.compile(rb"[^\d\s:=][^\s:=]{0,31}[ \t]?[:=][ \t]{0,8}" + _DECIMAL)


@dataclass(frozen=True, slots=True, eq=False)
class Decoded:
    """Result of `decode`: `line` (N,) numbers of the good lines, counted from 0; `values` (N, read columns)."""

    line: NDArray[np.int64]
    values: NDArray[np.float64]
    bad_at: list[int]  # numbers of the bad lines, overlong lines included, in ascending order
    bad_lines: Counter[str]  # number of bad lines without the overlong ones, by the reason
    bad_bytes: int  # number of bytes in overlong lines


def with_newlines(data: bytes) -> bytes:
    """The same lines, each ended by LF, of lines that end in CR, LF or CRLF. A CRLF that two calls cut becomes a blank
    line more, which `decode` skips."""
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in data else data


@functools.cache
def _pattern(fields: tuple[bytes, ...]) -> re.Pattern[bytes]:
    forms = [separator.join(fields) + end for separator, end in _SEPARATORS]
    return re.compile(_BLANKS + b"(?:" + b"|".join(forms) + b")" + _BLANKS)


def decode(text: bytes, columns: int, ignored: frozenset[int] = frozenset()) -> Decoded:
    """Decode complete lines, each ended by LF, with `columns` fields each; those at `ignored` may hold anything.

    Blank lines and comments (#) are skipped. A line is bad if it has another number of fields, a field that is not a
    decimal number, or a value beyond LARGEST_EXACT. Takes about 1.5 us per line, good or bad, on a desktop core.
    """
    lines = text.split(b"\n")[:-1]
    is_good = _pattern(tuple(_ANYTHING if i in ignored else _DECIMAL for i in range(columns))).fullmatch
    shaped = [number for number, line in enumerate(lines) if is_good(line)]
    fields = b" ".join([lines[number] for number in shaped]).translate(_TO_BLANKS).split()
    if ignored:
        fields = [field for at, field in enumerate(fields) if at % columns not in ignored]
    values = np.array(list(map(float, fields))).reshape(-1, columns - len(ignored))
    sound = (np.abs(values) <= LARGEST_EXACT).all(axis=1)
    line = np.array(shaped, np.int64)[sound]
    bad = _bad(lines, line.tolist()) if len(line) < len(lines) else {}
    overlong = [len(text) + 1 for text in bad.values() if _overlong(text)]
    faults = Counter(_fault(text) for text in bad.values() if not _overlong(text))
    return Decoded(line, values[sound], list(bad), faults, sum(overlong))


def _bad(lines: Sequence[bytes], good: Sequence[int]) -> dict[int, bytes]:
    """The bad lines by their numbers, of which `good` are the good ones."""
    others = sorted(set(range(len(lines))).difference(good))
    return {number: lines[number] for number in others if not _ignored(lines[number])}


def _ignored(line: bytes) -> bool:
    text = line.strip()
    return not text or (text.startswith(b"#") and not _overlong(line))


def _overlong(line: bytes) -> bool:
    return len(line) >= MAX_LINE_BYTES


def _fault(line: bytes) -> str:
    """What is wrong with a line, as far as the reader can do something about it."""
    if b"," in line and _WITH_COMMAS.fullmatch(line):
        return DECIMAL_COMMAS
    if _NAMED.match(line.lstrip()):
        return NAMED_NUMBERS
    fields = len(line.translate(_TO_BLANKS).split())
    if 0 < fields <= MOST_COLUMNS and _pattern((_DECIMAL,) * fields).fullmatch(line):
        return OTHER_COLUMNS
    return UNREADABLE
