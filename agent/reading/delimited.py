"""Text with delimiters (CSV, TSV, columns between blanks), also larger than memory.

Numbers are parsed by pyarrow where it is installed, otherwise by numpy. Lines that neither of them understands are
read one by one, and the first fault is told with its place.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.reading.dates import UnclearError, day_of, offset_in, order_of, seconds_of
from agent.reading.dialect import (
    COMMENT,
    COUNTERS,
    LARGEST,
    MISSING,
    SAMPLE_ROWS,
    Dialect,
    MixedMarksError,
    TableColumn,
    dialect_of_text,
    lines_of,
    names_columns,
    separates_thousands,
)
from agent.reading.lines import blocks, text_of
from agent.reading.long_form import remedy_of
from agent.reading.same_times import same_times, time_without_name
from agent.reading.source import Array, Column, Progress, Source, TableError
from calib.recorded.choice import names_time, words

BLOCK_BYTES = 1 << 20  # pyarrow parses blocks of a chunk on all cores
NEWLINE = ord("\n")
COUNTED = "time_s"  # the column of times that are counted from the rate in the head
_NO_ROW = re.compile(rf"(?m)^[ \t]*+(?:(?:{COMMENT}).*|[^\0\n]*+\0.*)\n".encode())
_NO_ROW_SEMICOLON = re.compile(rf"(?m)^[ \t]*+(?:(?:{COMMENT}|;).*|[^\0\n]*+\0.*)\n".encode())
_FORTRAN = re.compile(rb"(?<=[\d.])[dD](?=[+-]?\d)")


class Delimited(Source):
    """A text file with a table. `date_order`: of day, month and year, where it is stated. Raises TableError."""

    def __init__(self, path: Path, date_order: str = "") -> None:
        self.path = path
        self._text = text_of(path)
        self.dialect = dialect_of_text(self._text, date_order)
        names = self.dialect.header
        self.header = f"line {self.dialect.header_line}"
        named = [name for name in names if name]
        if len(set(named)) < len(named):
            raise TableError(f"{path}, {self.header}: a column is there twice, remove one: {','.join(names)!r}")
        self._parts = {Column(part.name, part.unit): part for part in self.dialect.parts}
        self._look_at_times()
        self._count_rows()
        self.columns = tuple(self._parts)
        self._parse = _arrow_parser() or _numpy
        self._lost = 0
        if self._text.unended:
            self._say(
                f"{path}: the last line, {self._text.unended!r:.70}, has no end and may be cut off; it is left out"
            )
        elif self._text.zeros:
            self._say(f"{path}: bytes 0 stand behind the last line, as after a power cut; they are left out")

    def _say(self, told: str) -> None:
        self.said = (*self.said, told)

    def _look_at_times(self) -> None:
        """Which columns tell the same times, and whether the rows hold one value each."""
        dialect = self.dialect
        first = enumerate(self._text.head[dialect.first_line - 1 :], start=dialect.first_line)
        rows = [dialect.fields(line) for _, line in dialect.rows(first)]
        rows = [row for row in rows if len(row) == len(dialect.header)]
        self.remedy = remedy_of(dialect.header, rows)
        if not dialect.names and (place := time_without_name(rows)) is not None:
            time = replace(dialect.parts[place], unit="")  # a unit in the head is that of the channels
            self._parts = {Column(time.name): time} | dict(list(self._parts.items())[place + 1 :])
        finest, *others = same_times(dialect, rows) or (None,)
        self.repeated = [column for column, part in self._parts.items() if part in others]
        if finest is not None:
            names = ", ".join(repr(part.name) for part in others)
            self._say(f"{self.path}: column {finest.name!r} tells the same times as {names}, and is taken")

    def _count_rows(self) -> None:
        """Where the head states a rate, and no column is a time: a column of times from the count of the samples."""
        parts, rate_hz = self._parts, self.dialect.rate_hz
        self.rate_hz = rate_hz
        unnamed = all(column.name.isdigit() for column in parts) and len(parts) > 3
        if rate_hz is None or unnamed or any(p.unit == "s" or names_time(p.name, p.unit) for p in parts.values()):
            return
        counter = next((part for part in parts.values() if COUNTERS & set(words(part.name) or [part.name])), None)
        self._parts = {
            Column(COUNTED): replace(counter, name=COUNTED) if counter else TableColumn(COUNTED, "", (), ()),
            **parts,
        }
        self.counted = COUNTED
        what = f"column {counter.name!r}, which counts the samples" if counter else "the number of the row"
        self._say(f"{self.path}: no column is a time; it is {what}, over the {rate_hz:g} Hz that the head states")

    def pieces(self, columns: Sequence[Column], progress: Progress | None) -> Iterator[Array]:
        """Yield the rows of these columns. Raises TableError for the first line that is wrong."""
        parts = [self._parts[column] for column in columns]
        for part in parts:
            if len(part.places) > 1:
                names = " and ".join(repr(self.dialect.header[place]) for place in part.places)
                self._say(f"{self.path}: column {part.name!r} is the sum of {names}")
        places = list(dict.fromkeys(place for part in parts for place in part.places))
        plain = len(places) == len(parts) and all(len(part.places) == 1 for part in parts)
        dialect = self._judged(places)
        line, row = 1, 0
        for text, last in _with_last(blocks(self._text, progress)):
            lines = int(np.count_nonzero(np.frombuffer(text, np.uint8) == NEWLINE))
            skip = dialect.first_line - line
            line += lines
            if skip >= lines:
                continue
            begin = 0
            for _ in range(skip):
                begin = text.index(b"\n", begin) + 1
            text = text[begin:]
            if not text.isspace():
                rows = self._rows(dialect, max(line - lines, dialect.first_line), text, places, last)
                yield rows if plain else np.column_stack([_sum(part, rows, places, row) for part in parts])
                row += len(rows)
        if self._lost:
            self._say(f"{self.path}: lines that are cut off or have bytes 0: {self._lost}; they are left out")

    def place(self, row: int) -> str:
        """The line that holds row `row`."""
        numbers = (number for number, _ in lines_of(self.path, self.dialect))
        return f"line {next(itertools.islice(numbers, row, None), self.dialect.first_line + row)}"

    def _judged(self, places: Sequence[int]) -> Dialect:
        """The dialect of these columns: their decimal mark, and the order of their dates. Raises TableError."""
        dialect = self.dialect
        commas = tuple(comma if k in places else "" for k, comma in enumerate(dialect.commas))
        first = enumerate(self._text.head[dialect.first_line - 1 :], start=dialect.first_line)
        sample = [dialect.fields(line) for _, line in itertools.islice(dialect.rows(first), SAMPLE_ROWS)]
        cells = [row[k] for row in sample for k in places if len(row) > k]
        if any(commas) and separates_thousands(cells):
            comma = next(filter(None, commas))
            raise TableError(
                f"{self.path}, line {dialect.first_line}: in {comma!r} the comma may be a decimal mark, or separate "
                f"thousands; write {comma.replace(',', '.')} or {comma.replace(',', '')}"
            )
        dialect = replace(dialect, commas=commas)
        if dialect.comma:
            self._say(f"{self.path}: the comma is taken as the decimal mark, as in {dialect.comma!r}")
        dated = [k for k in places if dialect.moments[k] in ("day", "both")]
        return replace(dialect, order=self._order(dialect, dated[0], sample)) if dated else dialect

    def _order(self, dialect: Dialect, column: int, sample: Sequence[Sequence[str]]) -> str:
        """The order of the dates in a column, by all its lines where the first ones leave it open."""
        order = dialect.order or order_of(self._days(dialect, column))
        first = next((day_of(row[column]) for row in sample if len(row) > column), "")
        if order and first and not first[:4].isdecimal():
            with contextlib.suppress(UnclearError):
                day = np.datetime64(int(seconds_of([first], order)[0]), "s").astype("datetime64[D]")
                self._say(f"{self.path}: the date {first!r} is taken as {day}")
        return order

    def _days(self, dialect: Dialect, column: int) -> Iterator[str]:
        """The dates in a column, of all lines."""
        for text in blocks(self._text):
            for line in text.decode("latin-1").split("\n"):
                fields = dialect.fields(line)
                if len(fields) > column and (day := day_of(fields[column])):
                    yield day

    def _rows(self, dialect: Dialect, line: int, text: bytes, places: Sequence[int], last: bool) -> Array:
        if not places:
            return np.empty((sum(1 for _ in dialect.rows(enumerate(text.decode("latin-1").split("\n")))), 0))
        with contextlib.suppress(ValueError):
            rows = self._parse(_rows_alone(text, dialect), dialect, places)
            least, most = np.fmin.reduce(rows, axis=None), np.fmax.reduce(rows, axis=None)
            if not (least < -LARGEST or most > LARGEST):
                self._lost += sum(b"\0" in told for told in text.split(b"\n")) if b"\0" in text else 0
                return rows
        return self._one_by_one(dialect, line, text, places, last)

    def _one_by_one(self, dialect: Dialect, line: int, text: bytes, places: Sequence[int], last: bool) -> Array:
        encoding = "utf-8" if dialect.encoding.startswith("utf") else dialect.encoding
        told = [(n, content) for n, content in enumerate(text.decode(encoding, "replace").split("\n"), start=line)]
        self._lost += sum("\0" in content for _, content in told)
        told = list(dialect.rows(told))
        if told and last and len(dialect.fields(told[-1][1])) < len(dialect.header):
            self._lost += 1
            told.pop()
        parsed = []
        for number, content in told:
            found = dialect.fields(content)
            if names_columns(found):
                raise TableError(
                    f"{self.path}, line {number}: {content!r:.70} has words and no value; if columns or units are "
                    "others from here on, cut the file here, else remove the line"
                )
            fields = fields_of(self.path, number, found, dialect.header)
            parsed.append([number_of(self.path, number, dialect, k, fields[k]) for k in places])
        return np.array(parsed).reshape(-1, len(places))


def _sum(part: TableColumn, rows: Array, places: Sequence[int], first: int) -> Array:
    """The values of a column: the sum of its fields; without fields the number of the row."""
    if not part.places:
        return np.arange(first, first + len(rows), dtype=float)
    fields = [rows[:, places.index(place)] * per for place, per in zip(part.places, part.per, strict=True)]
    return np.asarray(sum(fields[1:], start=fields[0]))


def _with_last(items: Iterator[bytes]) -> Iterator[tuple[bytes, bool]]:
    """Each item, and whether it is the last one."""
    held = next(items, None)
    while held is not None:
        following = next(items, None)
        yield held, following is None
        held = following


def _rows_alone(text: bytes, dialect: Dialect) -> bytes:
    """The lines without comments and without those that have bytes 0, with exponents that all programs read."""
    if any(mark in text for mark in (b"#", b"%", b"//", b"\0")) or (dialect.delimiter != ";" and b";" in text):
        text = (_NO_ROW if dialect.delimiter == ";" else _NO_ROW_SEMICOLON).sub(b"", text)
    return _FORTRAN.sub(b"e", text) if dialect.fortran else text


def fields_of(path: Path, line: int, fields: list[str], header: Sequence[str]) -> list[str]:
    """The fields. Raises TableError if their number is not that of the header."""
    if len(fields) != len(header):
        commas = "; where commas are decimal marks too, separate the fields by semicolons" * (len(fields) > len(header))
        raise TableError(
            f"{path}, line {line}: {len(fields)} fields, but the header has {len(header)}; correct the line{commas}"
        )
    return fields


def number_of(path: Path, line: int, dialect: Dialect, column: int, text: str) -> float:
    """A number that is not larger than LARGEST, or NaN where it is missing. Raises TableError."""
    where = f"{path}, line {line}, column {dialect.header[column]}"
    try:
        value = dialect.number(text, column)
    except (UnclearError, MixedMarksError) as error:
        raise TableError(f"{where}: {error}") from None
    except ValueError:
        value = np.inf
    if np.isinf(value):
        raise TableError(f"{where}: {text.strip()!r} is not a finite number; correct it, or leave it empty for a gap")
    if abs(value) > LARGEST:
        raise TableError(f"{where}: {text.strip()!r} is larger than {LARGEST:g}; correct it, or leave it empty")
    return value


def _numpy(text: bytes, dialect: Dialect, places: Sequence[int]) -> Array:
    """The columns at `places` by numpy. Raises ValueError if anything is no plain number."""
    if any(dialect.moments[k] for k in places):
        return _with_moments(text, dialect, places)
    if dialect.comma:
        if dialect.delimiter == "," or b"." in text:
            raise ValueError
        text = text.replace(b",", b".")
    delimiter = None if dialect.delimiter == " " else dialect.delimiter
    rows = np.loadtxt(
        io.BytesIO(text), delimiter=delimiter, comments=None, ndmin=2, usecols=places, quotechar='"', encoding="latin-1"
    )
    if delimiter and text.count(delimiter.encode()) != len(rows) * (len(dialect.header) - 1):
        raise ValueError
    return rows


def _with_moments(text: bytes, dialect: Dialect, places: Sequence[int]) -> Array:
    """The same with dates or times of day in some of the columns."""
    fields = [dialect.fields(line) for line in text.decode("latin-1").split("\n") if line.strip()]
    if any(len(row) != len(dialect.header) for row in fields):
        raise ValueError
    columns = []
    for k in places:
        column = [row[k] for row in fields]
        moment = bool(dialect.moments[k])
        columns.append(_seconds(column, dialect, k) if moment else np.array([dialect.number(f, k) for f in column]))
    return np.column_stack(columns)


def _seconds(texts: Sequence[str], dialect: Dialect, column: int) -> Array:
    return seconds_of(texts, dialect.order, offset_in(dialect.header[column]))


def _arrow_parser() -> Any:
    """A function as `_numpy` by pyarrow, or None where pyarrow is not installed."""
    try:
        import pyarrow as pa
        from pyarrow import csv
    except ImportError:
        return None
    missing = sorted(MISSING | {name.upper() for name in MISSING} | {"NaN", "None"})

    def parse(text: bytes, dialect: Dialect, places: Sequence[int]) -> Array:
        if dialect.delimiter == " ":
            text = re.sub(rb"[ \t]+", b" ", re.sub(rb"(?m)^[ \t]+|[ \t]+$", b"", text))
        # A copy that belongs to Arrow: one of its threads may let go of it while the interpreter ends. With a buffer of
        # Python's, the process would then end with SIGABRT.
        own = pa.BufferOutputStream()
        own.write(text)
        names = [str(k) for k in range(len(dialect.header))]
        kinds = {names[k]: pa.string() if dialect.moments[k] else pa.float64() for k in places}
        try:
            table = csv.read_csv(
                pa.BufferReader(own.getvalue()),
                csv.ReadOptions(column_names=names, block_size=BLOCK_BYTES),
                csv.ParseOptions(delimiter=dialect.delimiter),
                csv.ConvertOptions(
                    column_types=kinds, include_columns=[names[k] for k in places], null_values=missing,
                    decimal_point="," if dialect.comma else ".",
                ),
            )  # fmt: skip
        except pa.ArrowInvalid as error:
            raise ValueError from error
        return np.column_stack([_values(table.column(names[k]).combine_chunks(), dialect, k) for k in places])

    def _values(column: Any, dialect: Dialect, k: int) -> Array:
        if pa.types.is_string(column.type):
            return _seconds(column.to_pylist(), dialect, k)
        return np.asarray(np.from_dlpack(column.fill_null(np.nan) if column.null_count else column))

    return parse
