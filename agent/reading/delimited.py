"""Text with delimiters (CSV, TSV, columns between blanks), also larger than memory.

Numbers are parsed by pyarrow where it is installed, otherwise by numpy. Lines that neither of them understands are
read one by one, and the first fault is told with its place.
"""

from __future__ import annotations

import codecs
import contextlib
import io
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from agent.reading.dialect import LARGEST, MISSING, Dialect, dialect_of, lines_of, seconds_of
from agent.reading.source import Array, Column, Progress, Source, TableError

CHUNK_BYTES = 1 << 23
BLOCK_BYTES = 1 << 20  # pyarrow parses blocks of a chunk on all cores
LONGEST_LINE = 1 << 20
NEWLINE = ord("\n")


class Delimited(Source):
    """A text file with a table. Raises TableError."""

    def __init__(self, path: Path) -> None:
        self.path, self.dialect = path, dialect_of(path)
        names = self.dialect.header
        self.header = f"line {self.dialect.header_line}"
        named = [name for name in names if name]
        if len(set(named)) < len(named):
            raise TableError(f"{path}, {self.header}: a column is there twice, remove one: {','.join(names)!r}")
        dates = self.dialect.dates
        self.columns = tuple(
            Column(name, "s" if dates[k] else self.dialect.units[k]) for k, name in enumerate(names) if name
        )
        self._parse = _arrow_parser() or _numpy

    def pieces(self, columns: Sequence[Column], progress: Progress | None) -> Iterator[Array]:
        """Yield the rows of these columns. Raises TableError for the first line that is wrong."""
        places = [self.dialect.header.index(column.name) for column in columns]
        line = 1
        with self.path.open("rb") as file:
            for text in _whole_lines(self.path, file, self.dialect, progress):
                lines = int(np.count_nonzero(np.frombuffer(text, np.uint8) == NEWLINE))
                skip = self.dialect.first_line - line
                line += lines
                if skip >= lines:
                    continue
                begin = 0
                for _ in range(skip):
                    begin = text.index(b"\n", begin) + 1
                text = text[begin:]
                if not text.isspace():
                    yield self._rows(max(line - lines, self.dialect.first_line), text, places)

    def place(self, row: int) -> str:
        """The line that holds row `row`."""
        numbers = (number for number, _ in lines_of(self.path, self.dialect))
        return f"line {next(itertools.islice(numbers, row, None), self.dialect.first_line + row)}"

    def _rows(self, line: int, text: bytes, places: Sequence[int]) -> Array:
        with contextlib.suppress(ValueError):
            rows = self._parse(text, self.dialect, places)
            least, most = np.fmin.reduce(rows, axis=None), np.fmax.reduce(rows, axis=None)
            if not (least < -LARGEST or most > LARGEST):
                return rows
        return self._one_by_one(line, text, places)

    def _one_by_one(self, line: int, text: bytes, places: Sequence[int]) -> Array:
        dialect = self.dialect
        encoding = "utf-8" if dialect.encoding.startswith("utf") else dialect.encoding
        told = text.decode(encoding, "replace").split("\n")
        parsed = []
        for number, content in enumerate(told, start=line):
            if not content.strip() or content.lstrip().startswith("#"):
                continue
            fields = fields_of(self.path, number, dialect.fields(content), dialect.header)
            parsed.append([number_of(self.path, number, dialect, k, fields[k]) for k in places])
        return np.array(parsed).reshape(-1, len(places))


def fields_of(path: Path, line: int, fields: list[str], header: Sequence[str]) -> list[str]:
    """The fields. Raises TableError if their number is not that of the header."""
    if len(fields) != len(header):
        raise TableError(
            f"{path}, line {line}: {len(fields)} fields, but the header has {len(header)}; correct the line"
        )
    return fields


def number_of(path: Path, line: int, dialect: Dialect, column: int, text: str) -> float:
    """A number that is not larger than LARGEST, or NaN where it is missing. Raises TableError."""
    where = f"{path}, line {line}, column {dialect.header[column]}"
    try:
        value = dialect.number(text)
    except ValueError:
        value = np.inf
    if np.isinf(value):
        raise TableError(f"{where}: {text.strip()!r} is not a finite number; correct it, or leave it empty for a gap")
    if abs(value) > LARGEST:
        raise TableError(f"{where}: {text.strip()!r} is larger than {LARGEST:g}; correct it, or leave it empty")
    return value


def _whole_lines(path: Path, file: IO[bytes], dialect: Dialect, progress: Progress | None) -> Iterator[bytes]:
    """Yield whole lines as ASCII-compatible bytes, each ended by one newline, from the first line of the file."""
    decode = codecs.getincrementaldecoder("utf-16")("replace").decode if dialect.encoding == "utf-16" else None
    rest = b""
    while data := file.read(CHUNK_BYTES):
        if progress is not None:
            progress(len(data))
        data = decode(data).encode() if decode else data.removeprefix(codecs.BOM_UTF8)
        cut = data.rfind(b"\n") + 1
        if cut:
            yield b"".join((rest, memoryview(data)[:cut])).replace(b"\r", b"")
            rest = data[cut:]
        elif len(rest := rest + data) > LONGEST_LINE:
            raise TableError(f"{path}, line 1: the line is longer than {LONGEST_LINE} bytes; is the file text?")
    if rest.strip():
        yield rest.replace(b"\r", b"") + b"\n"


def _numpy(text: bytes, dialect: Dialect, places: Sequence[int]) -> Array:
    """The columns at `places` by numpy. Raises ValueError if anything is no plain number."""
    if any(dialect.dates[k] for k in places) and dialect.delimiter != " ":
        return _with_dates(text, dialect, places)
    if dialect.decimal_comma:
        if dialect.delimiter == ",":
            raise ValueError
        text = text.replace(b",", b".")
    delimiter = None if dialect.delimiter == " " else dialect.delimiter
    rows = np.loadtxt(
        io.BytesIO(text), delimiter=delimiter, comments=None, ndmin=2, usecols=places, quotechar='"', encoding="latin-1"
    )
    if delimiter and text.count(delimiter.encode()) != len(rows) * (len(dialect.header) - 1):
        raise ValueError
    return rows


def _with_dates(text: bytes, dialect: Dialect, places: Sequence[int]) -> Array:
    """The same with dates in some of the columns."""
    fields = [dialect.fields(line) for line in text.decode("latin-1").split("\n") if line.strip()]
    if any(len(row) != len(dialect.header) for row in fields):
        raise ValueError
    columns = []
    for k in places:
        column = [row[k] for row in fields]
        columns.append(seconds_of(column) if dialect.dates[k] else np.array([dialect.number(f) for f in column]))
    return np.column_stack(columns)


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
        kinds = {names[k]: pa.string() if dialect.dates[k] else pa.float64() for k in places}
        try:
            table = csv.read_csv(
                pa.BufferReader(own.getvalue()),
                csv.ReadOptions(column_names=names, block_size=BLOCK_BYTES),
                csv.ParseOptions(delimiter=dialect.delimiter),
                csv.ConvertOptions(
                    column_types=kinds, include_columns=[names[k] for k in places], null_values=missing,
                    decimal_point="," if dialect.decimal_comma else ".",
                ),
            )  # fmt: skip
        except pa.ArrowInvalid as error:
            raise ValueError from error
        return np.column_stack([_values(table.column(names[k]).combine_chunks()) for k in places])

    def _values(column: Any) -> Array:
        if pa.types.is_string(column.type):
            return seconds_of(column.to_pylist())
        return np.asarray(np.from_dlpack(column.fill_null(np.nan) if column.null_count else column))

    return parse
