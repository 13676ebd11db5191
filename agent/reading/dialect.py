"""How a text file writes its table: delimiter, decimal mark, comment lines, header, units, dates, and the rate."""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from agent.reading.dates import day_of, has_clock, has_day, is_moment, offset_in, order_in, order_of, seconds_of
from agent.reading.lines import Text, text_of
from agent.reading.source import TableError
from calib.recorded.choice import names_time, part_of_seconds, words
from calib.recorded.units import split as name_and_unit
from calib.recorded.units import unit_of

SAMPLE_ROWS = 50  # rows from which the dialect is found
RATES_HZ = 1e-6, 1e8  # of loggers
MOST_DIGITS = 12  # of the number of a row
HEAD_ROWS = 10  # lines with words and values that a head may have before the names
LARGEST = 1e19  # no indication and no time in ns since 1970 is larger, and its squares and their sums stay finite
# A line of comment; also one with ";" where that is no delimiter. A first cell may have an error of a spreadsheet.
COMMENT = r"#(?!N/[AV]|[A-Z/0]+[!?])|%|//"
DELIMITERS = (";", "\t", ",", "|", " ")  # in this order: numbers may contain a comma, dates a blank
NO_NUMBERS = frozenset(("nan", "-nan", "na", "n/a", "#n/a", "null", "none"))
# Cells of loggers where a value is missing or was outside the range.
MISSING = NO_NUMBERS | {
    "", "-", "--", "---", "----", "-----", "over", "+over", "-over", "ol", "+ol", "-ol", "overrange", "overload",
    "#n/v", "no data", "nodata", "burnout", "+++++++", "-------", "+++++", "*****", "******", "overrun", "overflow",
    "1.#qnan", "-1.#qnan", "1.#ind", "-1.#ind",
}  # fmt: skip
COMMENT_COLUMNS = frozenset(("comment", "comments", "note", "notes", "event", "events", "marker", "annotation"))
# Rows below the names that are none: units and kinds of values, as TOA5 and others have them.
SECOND_ROWS = frozenset(
    ("ts", "rn", "smp", "avg", "min", "max", "std", "tot", "cal", "raw", "uncal", "date", "time", "no unit", "unitless")
)
COUNTERS = frozenset(("counter", "packetcounter", "count", "index", "sample", "samples", "record", "scan", "no", "n"))
THOUSANDTHS = frozenset(("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"))
_COMMENT = re.compile(COMMENT)
_WHOLE = re.compile(r"\d{1,19}")
_FORTRAN = re.compile(r"[+-]?(?:\d++\.?\d*+|\.\d++)[dD][+-]?\d+")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
_BETWEEN_BLANKS = re.compile(r'"([^"]*)"|(\S+)')
_NUMERIC = re.compile(r"[+-]?[\d.,]+(?:[eE][+-]?\d+)?")
_GROUPED = re.compile(r"[+-]?\d{1,3}(?:,\d{3})+(?:\.\d+)?")
# No digits of a name, such as those of the module MX840 in the next column.
_VALUE = r"[^\d\n]{0,30}?(?<![^\W\d])(?P<value>\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)[;,\t ]*(?:[A-Za-z\xb5/]+)?"
_RATE = re.compile(
    r"(?:(?:sampl\w{0,8}|scan|update|data|output|measurement|acquisition|logging|recording)[\s_]{0,4}(?:rate|freq\w*)"
    rf"|\b(?:rate|freq|frequency|fs|odr|at)\b){_VALUE}",
    re.IGNORECASE,
)
_INTERVAL = re.compile(rf"(?:\binterval|sampl\w{{0,8}} (?:period|time)|\bdelta_x\b|\bdt\b){_VALUE}", re.IGNORECASE)
_UNITS = re.compile(
    r"[#%/*\s]*(?:(?:eu|y|engineering|measur\w+|channels?|signals?|data|output|acc\w*) )?units?"
    r"\s*[:=,;\t][:=,;\s]*(.+)",
    re.IGNORECASE,
)
_HERTZ = {"hz": 1.0, "khz": 1e3, "sps": 1.0, "s/s": 1.0}
_SECONDS = re.compile(r"(?<![a-z])(?:[mun\xb5]s|s|m?sec)(?![a-z])", re.IGNORECASE)


class MixedMarksError(ValueError):
    """A number whose comma or point may separate thousands. The message says what to do."""


@dataclass(frozen=True, slots=True)
class TableColumn:
    """A column of the table: its name and unit, and the places of the fields whose sum it is.

    A date and a time of day in two columns are one, and so are a time of day and its ms, and seconds and their ns.
    `per`: what one unit of each field is in that of the column.
    """

    name: str
    unit: str
    places: tuple[int, ...]
    per: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a file writes its table.

    `first_line`: number of the first line of data. `units`: of each column, or "". `moments`: what the cells of each
    column are: "day", "clock", "both", or "" for numbers. `commas`: the first number with a comma in each column, or
    "". `order`: of day, month and year, "" where it is not known. `rate_hz`: as the head states it. `fortran`: whether
    exponents have a D. `before`: the lines before the data. `names`: the one that names the columns.
    """

    encoding: str
    delimiter: str
    commas: tuple[str, ...]
    header: tuple[str, ...]
    header_line: int
    units: tuple[str, ...]
    first_line: int
    moments: tuple[str, ...]
    parts: tuple[TableColumn, ...]
    order: str = ""
    rate_hz: float | None = None
    fortran: bool = False
    before: frozenset[str] = frozenset()
    names: str = ""

    @property
    def comma(self) -> str:
        """The first number with a decimal comma, "" where a point is the decimal mark."""
        return next((comma for comma in self.commas if comma), "")

    def fields(self, line: str) -> list[str]:
        """The fields of a line, without the blanks around them."""
        return _fields(line, self.delimiter)

    def rows(self, lines: Iterable[tuple[int, str]]) -> Iterator[tuple[int, str]]:
        """The lines of data among numbered lines: no comments, none with bytes 0, and no head that is repeated."""
        held: list[tuple[int, str]] = []
        for number, line in lines:
            plain = line.strip()
            if plain and plain == self.names:
                held.clear()  # lines that are no rows, and the names after them, are a head that is repeated
            elif not _is_data(line, self.delimiter) or "\0" in line or plain in self.before:
                continue
            elif len(held) < len(self.before) and len(self.fields(line)) != len(self.header):
                held.append((number, line))
            else:
                yield from (*held, (number, line))
                held.clear()
        yield from held

    def number(self, text: str, column: int) -> float:
        """A number, a date in s since 1970, a time of day in s, or NaN for a value that is missing.

        Raises ValueError; UnclearError and MixedMarksError say what to do.
        """
        plain = text.strip()
        if plain.lower() in MISSING:
            return math.nan
        if is_moment(plain):
            return float(seconds_of([plain], self.order, offset_in(self.header[column]))[0])
        if self.comma and "." in plain and _NUMERIC.fullmatch(plain):
            raise MixedMarksError(
                f"{plain!r} has a point, and {self.comma!r} a comma; write the numbers without separators of thousands"
            )
        if not self.comma and "," in plain and _NUMERIC.fullmatch(plain):
            raise MixedMarksError(
                f"{plain!r} has a comma, and other numbers have none; write all numbers with one decimal mark, and "
                "without separators of thousands"
            )
        if _FORTRAN.fullmatch(plain.replace(",", ".")):
            plain = plain.upper().replace("D", "E")
        return float(plain.replace(",", ".") if self.comma else plain)


def lines_of(path: Path, dialect: Dialect) -> Iterator[tuple[int, str]]:
    """The lines of data with their numbers, without empty lines and comments. Raises TableError."""
    try:
        with path.open(encoding=dialect.encoding, errors="replace") as file:
            lines = ((number, line.rstrip("\n")) for number, line in enumerate(file, start=1))
            yield from dialect.rows(itertools.islice(lines, dialect.first_line - 1, None))
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from None


def dialect_of(path: Path, order: str = "") -> Dialect:
    """Find how the file writes its table. `order`: of day, month and year, as it is stated. Raises TableError."""
    return dialect_of_text(text_of(path), order)


def dialect_of_text(text: Text, order: str = "") -> Dialect:
    """The same of a file whose lines are known."""
    lines = text.head
    for enough, delimiter in itertools.product((_all_values, _some_values), DELIMITERS):
        told = [(n, line) for n, line in enumerate(lines, start=1) if _is_data(line, delimiter) and "\0" not in line]
        split = [(n, _fields(line, delimiter)) for n, line in told[: 10 * SAMPLE_ROWS]]
        if _first_row(split, enough) is not None:
            first = _first_row(split, _some_values)
            assert first is not None  # lines of which all fields are values have two of them
            return _of_rows(text.encoding, delimiter, lines, split, first, order)
    told = [(n, line) for n, line in enumerate(lines, start=1) if _is_data(line, "")]
    if not told:
        raise TableError(f"{text.path}, line 1: the file has only comments; expected a header such as time_s,vx,vy,vz")
    number, line = told[0]
    delimiter = max(DELIMITERS[:4], key=line.count)
    header = tuple(_fields(line, delimiter))
    nothing = ("",) * len(header)
    parts = tuple(TableColumn(name, "", (k,), (1.0,)) for k, name in enumerate(header) if name)
    return Dialect(text.encoding, delimiter, nothing, header, number, nothing, number + 1, nothing, parts)


def dialect_of_cells(rows: Sequence[tuple[int, list[str]]], order: str = "") -> Dialect | None:
    """How a sheet of cells writes its table, None where it has none. `rows`: the first ones, each with its number."""
    split = [(n, cells) for n, cells in rows if any(cells) and not is_comment(cells[0])]
    for enough in (_all_values, _some_values):
        if _first_row(split, enough) is not None:
            first = _first_row(split, _some_values)
            assert first is not None  # lines of which all fields are values have two of them
            return _of_rows("", "", [" ".join(cells) for _, cells in rows], split, first, order)
    return None


def _first_row(split: Sequence[tuple[int, list[str]]], enough: Callable[[Sequence[str]], bool]) -> int | None:
    """The first of two lines that have enough values; the last line needs no second one.

    A line of the head may have values too: it has words where other lines have none, and names follow it soon.
    """
    rows = [fields for _, fields in split]
    usual, after = _usual_words(rows, enough), 0
    for k in range(len(rows)):
        if k < after or not all(enough(row) for row in rows[k : k + 2]):
            continue
        soon = rows[k : k + HEAD_ROWS]
        named = next((n for n, row in enumerate(soon) if names_columns(row)), 0)
        if named and all(_words_in(row) - usual for row in soon[:named]):
            after = k + named
            continue
        return k
    return None


def _usual_words(rows: Sequence[list[str]], enough: Callable[[Sequence[str]], bool]) -> set[int]:
    """The fields that are words in most of the lines that have enough values."""
    worded = Counter(k for fields in rows if enough(fields) for k in _words_in(fields))
    return {k for k, count in worded.items() if 2 * count > sum(map(enough, rows))}


def names_columns(fields: Sequence[str]) -> bool:
    """Whether a line has several words and no value."""
    return len(_words_in(fields)) > 1 and not any(map(is_number_or_moment, fields))


def _words_in(fields: Sequence[str]) -> set[int]:
    """The fields that are neither values nor missing ones."""
    return {k for k, field in enumerate(fields) if not is_number_or_moment(field) and field.lower() not in MISSING}


def _before(
    lines: Sequence[str], split: Sequence[tuple[int, list[str]]], delimiter: str, rows: Sequence[list[str]]
) -> tuple[list[tuple[int, list[str]]], int]:
    """The lines before the data that may be their header, and the number of columns. The last of `split` is data."""
    *above, (first_line, _) = split
    width = len(rows[0])
    before = [(n, named) for n, fields in above if (named := _named(fields, width)) is not None]
    if not before:
        before = _in_comment(lines, first_line, delimiter, width)
    if not before and above and len(above[-1][1]) > 1 and not any(map(is_number_or_moment, above[-1][1])):
        before = [above[-1]]  # the rows have another number of fields, which their reader tells
        width = len(_stripped(before[0][1]))
    if before and len(before[-1][1]) != width and _is_counted(rows):
        width = len(before[-1][1])
    return before, width


def _of_rows(
    encoding: str, delimiter: str, lines: Sequence[str], split: Sequence[tuple[int, list[str]]], first: int, order: str
) -> Dialect:
    """The dialect of a file whose lines are split, the line at `first` being the first line of data."""
    rows = [fields for _, fields in split[first : first + SAMPLE_ROWS]]
    first_line = split[first][0]
    before, width = _before(lines, split[: first + 1], delimiter, rows)
    header, header_line, units = _header(before, width)
    head = tuple(lines[: first_line - 1])
    units = units if any(map(unit_of, units)) else _units_in(head, delimiter, header) or units
    cells = [[row[k] for row in rows if len(row) > k and row[k].lower() not in MISSING] for k in range(width)]
    moments = tuple(map(_moments, cells))
    days = _days(cells, moments)
    fortran = any(_FORTRAN.fullmatch(cell.replace(",", ".")) for cell in itertools.chain.from_iterable(cells))
    return Dialect(
        encoding, delimiter, tuple(_comma(column) for column in cells), header, header_line, units, first_line,
        moments, _parts(header, units, moments, cells),
        order or order_in(" ".join(head)) or order_of(days), _rate_hz(head), fortran,
        frozenset(map(str.strip, head)), lines[header_line - 1].strip() if before and lines else "",
    )  # fmt: skip


def _units_in(head: Sequence[str], delimiter: str, header: Sequence[str]) -> tuple[str, ...]:
    """Units of the columns that a line of the head states, as "Unit: g" or "EU Units,g,g,g"; empty where none does, or
    where names have units.

    One unit is that of each channel; several are those of the channels in their order.
    """
    channels = [k for k, name in enumerate(header) if name and not names_time(name) and not COUNTERS & set(words(name))]
    told = {
        tuple(filter(None, map(str.strip, found[1].split(delimiter if delimiter.strip() else None))))
        for line in head if (found := _UNITS.fullmatch(line.replace('"', "").strip()))
    }  # fmt: skip
    stated = told.pop() if len(told) == 1 else ()
    known = [unit for text in stated if (unit := unit_of(text)) and unit.quantity not in ("time", "temperature")]
    named = any(name_and_unit(header[k])[1] for k in channels)
    if not stated or named or len(known) < len(stated) or len(stated) not in (1, len(channels)):
        return ()
    of = dict(zip(channels, stated if len(stated) > 1 else stated * len(channels), strict=True))
    return tuple(of.get(k, "") for k in range(len(header)))


def _days(cells: Sequence[list[str]], moments: Sequence[str]) -> list[str]:
    """The days in the columns that have some."""
    dated = [column for column, kind in zip(cells, moments, strict=True) if kind in ("day", "both")]
    return [day_of(cell) for column in dated for cell in column if has_day(cell)]


def _named(fields: list[str], width: int) -> list[str] | None:
    """The fields of a line that may name so many columns, None where it cannot. Columns of comments may be missing."""
    names = fields[:width] if all(f.lower() in COMMENT_COLUMNS for f in _stripped(fields)[width:]) else fields
    return names if len(_stripped(names)) in (width - 1, width) else None


def _header(before: Sequence[tuple[int, list[str]]], width: int) -> tuple[tuple[str, ...], int, tuple[str, ...]]:
    """Names, their line and units from the lines before the data; names are numbers where there is no header."""
    nothing = ("",) * width
    if not before:
        return tuple(str(k + 1) for k in range(width)), 1, nothing
    (line, names), units, above = before[-1], nothing, list(before[:-1])
    while above and _is_second(names, above[-1][1]):
        if not any(map(unit_of, units)):
            units = tuple([*names, *nothing][:width])
        line, names = above.pop()
    filled = [*names, *nothing][:width]
    if above and not all(filled):  # the names of some columns stand a line higher
        filled = [name or higher for name, higher in zip(filled, [*above[-1][1], *nothing], strict=False)]
    return tuple(filled), line, units


def _is_second(fields: Sequence[str], above: Sequence[str]) -> bool:
    """Whether a line tells units or kinds of the columns that the line above names."""
    stated = [f for f in fields if f.strip("-[]() ")]
    if not stated or all(unit_of(f) or f.strip("[]() ").lower() in SECOND_ROWS for f in stated):
        return bool(stated) or any(above)
    if len(set(stated)) == 1 < len(stated):
        return True
    names = [f for f in above if f]
    return len(set(stated)) < len(stated) <= len(names) == len(set(names)) and not any(map(is_number_or_moment, names))


def _in_comment(lines: Sequence[str], stop: int, delimiter: str, width: int) -> list[tuple[int, list[str]]]:
    """The last line of comment before line `stop`, if it has a name for each column, as numpy writes it."""
    for number, line in reversed(list(enumerate(lines[: stop - 1], start=1))):
        if line.strip() and not _is_data(line, delimiter):
            fields = _fields(re.sub(r"^[#%/;\s]*(?:[Hh]eaders?\s*[,:])?\s*", "", line), delimiter)
            return [(number, fields)] if len(fields) == width else []
    return []


def _is_counted(rows: Sequence[Sequence[str]]) -> bool:
    """Whether rows begin with their own numbers, for which some programs write no name, and end with a value."""
    counted = [row[0] for row in rows]
    first = int(counted[0]) if counted[0].isdecimal() and len(counted[0]) < MOST_DIGITS else 0
    return first > 0 and counted == [str(first + k) for k in range(len(rows))] and any(row[-1] for row in rows)


def _moments(cells: Sequence[str]) -> str:
    """What the cells of a column are: "day", "clock", "both", or "" for numbers."""
    if any(map(has_day, cells)):
        return "both" if any(map(has_clock, cells)) else "day"
    return "clock" if any(map(is_moment, cells)) else ""


def _parts(
    header: Sequence[str], units: Sequence[str], moments: Sequence[str], cells: Sequence[Sequence[str]]
) -> tuple[TableColumn, ...]:
    """The columns of the table. A moment is called "time" where no name tells a time."""
    with_clock, seconds = _clocks_of_days(moments), _parts_of_seconds(header, cells)
    parts: dict[int, TableColumn] = {}
    for k, name in enumerate(header):
        places, per = [k], [1.0]
        if k in with_clock.values():
            day = next(d for d, clock in with_clock.items() if clock == k)
            places, per, name = [day, k], [1.0, 1.0], name or header[day]
        if moments[k] in ("clock", "both") and _counts_thousandths(header, cells, k):
            places, per = [*places, k + 1], [*per, 1e-3]
        if k in seconds:
            places, per = [k, seconds[k][0]], [1.0, seconds[k][1]]
        if k not in with_clock and name and not any(k in part.places for part in parts.values()):
            parts[k] = TableColumn(name, "s" if moments[k] else units[k], tuple(places), tuple(per))
    return tuple(_with_time(parts, moments).values())


def _with_time(parts: dict[int, TableColumn], moments: Sequence[str]) -> dict[int, TableColumn]:
    """The parts; the only moment among them is called "time" where no name tells a time."""
    told = [k for k, part in parts.items() if part.unit == "s" and moments[k]]
    if len(told) != 1 or any(names_time(part.name, part.unit) for part in parts.values()):
        return parts
    only = parts[told[0]]
    return parts | {told[0]: TableColumn("time", only.unit, only.places, only.per)}


def _clocks_of_days(moments: Sequence[str]) -> dict[int, int]:
    """The column with the time of day that belongs to each column with a day."""
    days, clocks = ([k for k, kind in enumerate(moments) if kind == which] for which in ("day", "clock"))
    return {day: clock for day in days for clock in clocks if abs(day - clock) == 1 or len(clocks) == 1}


def _parts_of_seconds(header: Sequence[str], cells: Sequence[Sequence[str]]) -> dict[int, tuple[int, float]]:
    """The columns of whole seconds, each with the column behind it that has their parts, and one of these in s."""
    found = {}
    for k, (name, behind) in enumerate(itertools.pairwise(header)):
        per = part_of_seconds(name, behind)
        whole = per and all(map(_WHOLE.fullmatch, (*cells[k], *cells[k + 1])))
        if whole and all(int(part) * per < 1.0 for part in cells[k + 1]):
            found[k] = (k + 1, per)
    return found


def _counts_thousandths(header: Sequence[str], cells: Sequence[Sequence[str]], clock: int) -> bool:
    """Whether the column behind a time of day in whole seconds counts its ms."""
    if clock + 1 >= len(header) or header[clock + 1].strip("[]() .").lower() not in THOUSANDTHS:
        return False
    return all(re.search(r":\d\d$", c) for c in cells[clock]) and all(
        c.isdigit() and len(c) < 4 for c in cells[clock + 1]
    )


def _rate_hz(lines: Sequence[str]) -> float | None:
    """The rate that a head states. None where it states none, or several."""
    plain = [line.replace('"', "").replace("'", "") for line in lines]
    stated = {rate for line in plain for rate in (*_rates_hz(line), *_of_intervals_hz(line))}
    rates = {rate for rate in stated if RATES_HZ[0] < rate < RATES_HZ[1]}
    return rates.pop() if len(rates) == 1 else None


def _rates_hz(line: str) -> Iterator[float]:
    """The rates that a line states as such."""
    for found in _RATE.finditer(line):
        name = found[0].lower()
        hertz = [scale for unit, scale in _HERTZ.items() if re.search(rf"(?<![a-z]){unit}(?![a-z])", name)]
        if hertz or not name.startswith(("rate", "freq", "fs", "odr", "at")):
            yield (hertz or [1.0])[0] * _plain_number(found["value"])


def _of_intervals_hz(line: str) -> Iterator[float]:
    """The rates that follow from intervals of time which a line states."""
    for found in _INTERVAL.finditer(line):
        unit = _SECONDS.search(found[0])
        second = unit_of(unit[0]) if unit else unit_of("s") if found[0].lower().startswith(("delta", "dt")) else None
        value = _plain_number(found["value"])
        if second is not None and value:
            yield round(1.0 / (value * second.si), 12)


def _plain_number(text: str) -> float:
    """A number of a head, 0 where a comma may separate thousands."""
    return 0.0 if _THOUSANDS.fullmatch(text) else float(text.replace(",", "."))


def _all_values(fields: Sequence[str]) -> bool:
    return _some_values(fields) and all(is_number_or_moment(f) or f.lower() in MISSING for f in fields)


def _some_values(fields: Sequence[str]) -> bool:
    """Whether there are two values, or one among fields in which a value is missing."""
    values = sum(map(is_number_or_moment, fields))
    rest = [f for f in fields if not is_number_or_moment(f)]
    return values >= 2 or (values == 1 and any(rest) and all(f.lower() in MISSING for f in rest))


def is_comment(text: str) -> bool:
    """Whether a line, or the first cell of a row, is a comment."""
    return _COMMENT.match(text) is not None


def _is_data(line: str, delimiter: str) -> bool:
    plain = line.strip()
    return bool(plain) and not is_comment(plain) and (delimiter == ";" or not plain.startswith(";"))


def _fields(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return [found[1] or found[2] or "" for found in _BETWEEN_BLANKS.finditer(line)] if '"' in line else line.split()
    try:
        return [
            f.strip() for f in next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter, skipinitialspace=True), [])
        ]
    except csv.Error:
        return [line]


def _stripped(fields: list[str]) -> list[str]:
    """The fields without empty ones at the end."""
    return list(itertools.dropwhile(lambda f: not f, fields[::-1]))[::-1]


@lru_cache(maxsize=1 << 13)
def is_number_or_moment(text: str) -> bool:
    """Whether a cell is a number, a date, a time of day, or a word for a missing number."""
    plain = text.replace(",", ".")
    try:
        float(plain)
    except ValueError:
        known = text.lower() in NO_NUMBERS or is_moment(text) or _GROUPED.fullmatch(text) or _FORTRAN.fullmatch(plain)
        return bool(known)
    return True


def _comma(cells: Sequence[str]) -> str:
    """The first number with a comma, "" where there is none."""
    return next((f for f in cells if "," in f and not is_moment(f) and is_number_or_moment(f)), "")


def separates_thousands(cells: Sequence[str]) -> bool:
    """Whether all numbers with a comma may have it between thousands, and no number says that it is a decimal comma."""
    numbers = [f for f in cells if f.lower() not in MISSING and not is_moment(f)]
    with_comma = [f for f in numbers if "," in f]
    plain = [f for f in numbers if "," not in f]
    return (
        bool(with_comma)
        and all(_THOUSANDS.fullmatch(f) for f in with_comma)
        and all(len(f.lstrip("+-")) < 4 for f in plain)
    )
