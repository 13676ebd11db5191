"""How a text file writes its table: encoding, delimiter, decimal mark, comment lines, header and row of units."""

from __future__ import annotations

import codecs
import csv
import itertools
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agent.reading.source import Array, TableError
from calib.recorded.units import unit_of

HEAD_BYTES = 1 << 16  # the table must begin in these
SAMPLE_ROWS = 50  # rows from which the dialect is found
LARGEST = 1e19  # no indication and no time in ns since 1970 is larger, and its squares and their sums stay finite
COMMENTS = ("#", "%", "//")
DELIMITERS = (";", "\t", ",", "|", " ")  # in this order: numbers may contain a comma, dates a blank
MISSING = frozenset(("", "nan", "-nan", "na", "n/a", "#n/a", "null", "none"))
_DATE = re.compile(
    r"(?P<date>(?:19|20)\d\d[-/]\d\d[-/]\d\d)[T ](?P<time>\d\d:\d\d(?::\d\d(?:[.,]\d{1,9})?)?)\s?"
    r"(?P<zone>Z|UTC|[+-]\d\d:?\d\d)?"
)


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a file writes its table. `first_line`: number of the first line of data. `units`: of each column, or ""."""

    encoding: str
    delimiter: str
    decimal_comma: bool
    header: tuple[str, ...]
    header_line: int
    units: tuple[str, ...]
    first_line: int
    dates: tuple[bool, ...] = ()  # which columns hold dates

    def fields(self, line: str) -> list[str]:
        """The fields of a line, without the blanks around them."""
        return _fields(line, self.delimiter)

    def number(self, text: str) -> float:
        """A number, a date in s since 1970, or NaN for a value that is missing. Raises ValueError."""
        plain = text.strip()
        if plain.lower() in MISSING:
            return math.nan
        if _DATE.fullmatch(plain):
            return float(seconds_of([plain])[0])
        return float(plain.replace(",", ".") if self.decimal_comma else plain)


def lines_of(path: Path, dialect: Dialect) -> Iterator[tuple[int, str]]:
    """The lines of data with their numbers, without empty lines and comments. Raises TableError."""
    try:
        with path.open(encoding=dialect.encoding, errors="replace") as file:
            for number, line in enumerate(file, start=1):
                if number >= dialect.first_line and _is_data(line):
                    yield number, line.rstrip("\n")
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from None


def dialect_of(path: Path) -> Dialect:
    """Find how the file writes its table. Raises TableError."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from None
    if not head.strip():
        raise TableError(f"{path}, line 1: the file is empty; expected a header such as time_s,vx,vy,vz")
    encoding = _encoding(path, head)
    text = codecs.getincrementaldecoder(encoding)(errors="replace").decode(head)
    lines = text.splitlines()
    if len(head) == HEAD_BYTES:
        lines = lines[:-1]
    return _found(path, encoding, lines)


def _encoding(path: Path, head: bytes) -> str:
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if b"\0" in head:
        raise TableError(f"{path}, line 1: the file is not text, and of no format that is known; write it as CSV")
    try:
        codecs.getincrementaldecoder("utf-8-sig")().decode(head)
    except UnicodeDecodeError:
        return "cp1252" if all(byte not in head for byte in (0x81, 0x8D, 0x8F, 0x90, 0x9D)) else "latin-1"
    return "utf-8-sig"


def _found(path: Path, encoding: str, lines: Sequence[str]) -> Dialect:
    told = [(n, line) for n, line in enumerate(lines, start=1) if _is_data(line)]
    for enough, delimiter in itertools.product((_all_values, _two_values), DELIMITERS):
        split = [(n, _fields(line, delimiter)) for n, line in told[: 10 * SAMPLE_ROWS]]
        if _first_row(split, enough) is not None:
            first = _first_row(split, _two_values)
            assert first is not None  # lines of which all fields are values have two of them
            return _of_rows(encoding, delimiter, lines, split, first)
    if not told:
        raise TableError(f"{path}, line 1: the file has only comments; expected a header such as time_s,vx,vy,vz")
    number, line = told[0]
    delimiter = max(DELIMITERS[:4], key=line.count)
    header = tuple(_fields(line, delimiter))
    return Dialect(encoding, delimiter, False, header, number, ("",) * len(header), number + 1, (False,) * len(header))


def dialect_of_cells(rows: Sequence[tuple[int, list[str]]]) -> Dialect | None:
    """How a sheet of cells writes its table, None where it has none. `rows`: the first ones, each with its number."""
    split = [(n, cells) for n, cells in rows if any(cells) and not cells[0].startswith(COMMENTS)]
    for enough in (_all_values, _two_values):
        if _first_row(split, enough) is not None:
            first = _first_row(split, _two_values)
            assert first is not None  # lines of which all fields are values have two of them
            return _of_rows("", "", (), split, first)
    return None


def _first_row(split: Sequence[tuple[int, list[str]]], enough: Callable[[Sequence[str]], bool]) -> int | None:
    """The first of two lines that have enough values; the last line needs no second one."""
    return next((k for k in range(len(split)) if all(enough(row) for _, row in split[k : k + 2])), None)


def _of_rows(
    encoding: str, delimiter: str, lines: Sequence[str], split: Sequence[tuple[int, list[str]]], first: int
) -> Dialect:
    """The dialect of a file whose lines are split, the line at `first` being the first line of data."""
    rows = [fields for _, fields in split[first : first + SAMPLE_ROWS]]
    width = len(rows[0])
    before = [(n, fields) for n, fields in split[:first] if len(_stripped(fields)) in (width - 1, width)]
    if not before:
        before = _in_comment(lines, split[first][0], delimiter, width)
    if not before and first and len(split[first - 1][1]) > 1 and not any(map(_is_value, split[first - 1][1])):
        before = [split[first - 1]]  # the rows have another number of fields, which their reader tells
        width = len(before[0][1])
    header, header_line, units = _header(before, width)
    decimal_comma = any(_decimal_comma(field) for row in rows for field in row)
    dates = tuple(any(len(row) > k and _DATE.fullmatch(row[k]) for row in rows) for k in range(width))
    return Dialect(encoding, delimiter, decimal_comma, header, header_line, units, split[first][0], dates)


def _all_values(fields: Sequence[str]) -> bool:
    return _two_values(fields) and all(_is_value(f) for f in fields if f)


def _two_values(fields: Sequence[str]) -> bool:
    return sum(_is_value(f) for f in fields) >= 2


def _header(before: Sequence[tuple[int, list[str]]], width: int) -> tuple[tuple[str, ...], int, tuple[str, ...]]:
    """Names, their line and units from the lines before the data; names are numbers where there is no header."""
    nothing = ("",) * width
    if not before:
        return tuple(str(k + 1) for k in range(width)), 1, nothing
    line, names = before[-1]
    units = nothing
    stated = [f for f in names if f.strip("-[]() ")]
    if len(before) > 1 and stated and all(unit_of(f) for f in stated):
        units, (line, names) = tuple([*names, ""][:width]), before[-2]
    return tuple([*names, *nothing][:width]), line, units


def _in_comment(lines: Sequence[str], stop: int, delimiter: str, width: int) -> list[tuple[int, list[str]]]:
    """The last line of comment before line `stop`, if it has a name for each column, as numpy writes it."""
    for number, line in reversed(list(enumerate(lines[: stop - 1], start=1))):
        if line.lstrip().startswith(COMMENTS):
            fields = _fields(line.lstrip().lstrip("#%/ "), delimiter)
            return [(number, fields)] if len(fields) == width else []
    return []


def _is_data(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(COMMENTS)


def _fields(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        return [f.strip() for f in next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter), [])]
    except csv.Error:
        return [line]


def _stripped(fields: list[str]) -> list[str]:
    """The fields without empty ones at the end."""
    return list(itertools.dropwhile(lambda f: not f, fields[::-1]))[::-1]


def _is_value(text: str) -> bool:
    if _DATE.fullmatch(text) or text.lower() in MISSING - {""}:
        return True
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _decimal_comma(text: str) -> bool:
    return "," in text and not _DATE.fullmatch(text) and _is_value(text)


def seconds_of(dates: Sequence[str]) -> Array:
    """Dates (ISO 8601) as seconds since 1970, UTC; a date without zone is taken as UTC. Raises ValueError."""
    found = [_DATE.fullmatch(text.strip()) for text in dates]
    if not all(found):
        raise ValueError
    plain = [f"{m['date'].replace('/', '-')}T{m['time'].replace(',', '.')}" for m in found if m]
    ns = np.array(plain, dtype="datetime64[ns]").astype(np.int64)
    shift = np.array([_zone_s(m["zone"]) for m in found if m])
    return np.asarray(ns // 10**9 - shift + (ns % 10**9) * 1e-9)


def _zone_s(zone: str | None) -> int:
    if not zone or zone in ("Z", "UTC"):
        return 0
    minutes = 60 * int(zone[1:3]) + int(zone[-2:])
    return 60 * (minutes if zone[0] == "+" else -minutes)
