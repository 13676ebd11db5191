"""Sheets of Excel (.xlsx) by openpyxl: each sheet with a table is a group. Nothing is computed, no link is followed."""

from __future__ import annotations

import math
import sys
import warnings
import zipfile
from array import array
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, time, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.config.xml import XmlError, check_xml
from agent.reading.dialect import LARGEST, Dialect, dialect_of_cells, is_comment
from agent.reading.own_process import Name, arrays_of, write_arrays
from agent.reading.source import Array, Arrays, Column, Progress, TableError
from calib.model import Slices

MOST_ROWS, MOST_COLUMNS = 1 << 20, 256  # of a sheet; Excel itself has no more rows
HEAD_ROWS = 200  # in which the table must begin
MEMORY_BYTES = 1 << 29  # that reading may take; a full sheet with five columns takes half of it
# Sheets of numbers shrink to a tenth. Each byte of XML takes longer to read than a byte of other formats.
MOST_EXPANSION, ALWAYS_ALLOWED_BYTES = 100, 1 << 24
PIECE_BYTES, OVERLAP_BYTES = 1 << 20, 32
LINKS = "xl/externalLinks/"
ROWS = "row of the sheet"  # name of the array that tells the place of each sample
REMEDY = "correct it, or write the sheet as CSV"


class Sheets(Arrays):
    """The sheets of a workbook. `rows`: where each sheet has its samples; `faults`: of columns with a cell that is no
    number, which must not be asked for."""

    header = "sheets"

    def __init__(
        self, path: Path, values: Mapping[Column, Slices], rows: Mapping[str, Slices], faults: Mapping[Column, str]
    ) -> None:
        super().__init__(path, values)
        self._rows, self._faults, self._group = rows, faults, ""

    def pieces(self, columns: Sequence[Column], progress: Progress | None) -> Iterator[Array]:
        """Yield the rows of these columns, which must be of one sheet. Raises TableError."""
        for column in columns:
            if column in self._faults:
                raise TableError(f"{self.path}, {self._faults[column]}; {REMEDY}")
        self._group = columns[0].group
        return super().pieces(columns, progress)

    def place(self, row: int) -> str:
        """Where the sheet has this row."""
        return f"row {int(self._rows[self._group][row : row + 1][0])}"


def open_xlsx(path: Path) -> Arrays:
    """The columns of each sheet that has a table. Raises TableError.

    openpyxl reads the file in a process of its own, because a hostile file can take all memory.
    """
    import openpyxl  # noqa: F401 - imported so that a missing library is told as such

    values: dict[Column, Slices] = {}
    rows: dict[str, Slices] = {}
    faults: dict[Column, str] = {}
    for (group, name, unit, fault), held in arrays_of("agent.reading.xlsx", path, MEMORY_BYTES, REMEDY):
        if name == ROWS:
            rows[group] = held
            continue
        column = Column(name, unit, group)
        values[column] = held
        if fault:
            faults[column] = fault
    return Sheets(path, values, rows, faults)


def _arrays(path: str) -> dict[Name, NDArray[Any]]:
    """The columns of all sheets, by sheet ("" where only one has a table), name and unit. Raises ValueError."""
    from openpyxl import load_workbook

    _check_parts(path)
    found: dict[Name, NDArray[Any]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # openpyxl's own, about what it does not keep
        book = load_workbook(path, read_only=True, data_only=True, keep_links=False)
        tables = [(sheet, dialect) for sheet in book.worksheets if (dialect := _dialect(sheet)) is not None]
        if not tables:
            raise ValueError("no sheet begins with a table of numbers")
        for sheet, dialect in tables:
            found |= _columns(sheet, dialect, sheet.title if len(tables) > 1 else "")
    return found


def _check_parts(path: str) -> None:
    """Raises ValueError where the workbook is far larger than its file, takes values from others, or has entities."""
    with zipfile.ZipFile(path) as archive:
        size, allowed = sum(part.file_size for part in archive.infolist()), MOST_EXPANSION * Path(path).stat().st_size
        if size > max(ALWAYS_ALLOWED_BYTES, allowed):
            raise ValueError(f"it has {size} bytes unpacked, far more than its size can hold")
        for part in archive.infolist():
            if part.filename.startswith(LINKS):
                raise ValueError("cells take their values from other files, which are not read")
            if not part.filename.endswith((".xml", ".rels")):
                continue
            with archive.open(part) as file:
                before = b""
                while data := file.read(PIECE_BYTES):
                    try:
                        check_xml(before + data)
                    except XmlError as error:
                        raise ValueError(f"{part.filename}: {error}") from None
                    before = data[-OVERLAP_BYTES:]


def _dialect(sheet: Any) -> Dialect | None:
    sheet.reset_dimensions()  # what the file says of them may be wrong
    rows = [[_text(cell) for cell in row] for row in sheet.iter_rows(1, HEAD_ROWS, 1, MOST_COLUMNS, values_only=True)]
    width = max((k + 1 for row in rows for k, text in enumerate(row) if text), default=0)
    return dialect_of_cells([(n, row[:width]) for n, row in enumerate(rows, start=1) if width])


def _columns(sheet: Any, dialect: Dialect, group: str) -> dict[Name, NDArray[Any]]:
    """The table of one sheet: columns that have a name, and the row of each sample."""
    parts = dialect.parts
    columns, rows, faults = [array("d") for _ in parts], array("q"), [""] * len(parts)
    width = max(place for part in parts for place in part.places) + 1
    first = dialect.first_line
    for number, row in enumerate(sheet.iter_rows(first, MOST_ROWS, 1, width, values_only=True), first):
        if all(cell is None for cell in row) or is_comment(str(row[0])):
            continue
        rows.append(number)
        for j, part in enumerate(parts):
            values = [_number(row[k], dialect, k) for k in part.places]
            columns[j].append(sum(value * per for value, per in zip(values, part.per, strict=True)))
            if math.inf in values and not faults[j]:
                k = part.places[values.index(math.inf)]
                where = f"sheet {sheet.title!r}, row {number}, column {dialect.header[k]}"
                faults[j] = f"{where}: {_text(row[k])!r:.70} is not a finite number below {LARGEST:g}"
    names = [(group, part.name, part.unit, fault) for part, fault in zip(parts, faults, strict=True)]
    found = dict(zip(names, map(np.asarray, columns), strict=True))
    return found | {(group, ROWS, "", ""): np.asarray(rows)}


def _number(cell: Any, dialect: Dialect, column: int) -> float:
    """The number in a cell; a date in s since 1970, a time of day or a duration in s, NaN where there is nothing, inf
    where it is no number."""
    if cell is None:
        return math.nan
    if isinstance(cell, float | int) and not isinstance(cell, bool):
        value = float(cell)
    else:
        try:
            value = dialect.number(_text(cell), column)
        except ValueError:
            return math.inf
    return math.inf if abs(value) > LARGEST else value


def _text(cell: Any) -> str:
    """A cell as a CSV file would have it."""
    if cell is None:
        return ""
    if isinstance(cell, datetime):
        return cell.astimezone(UTC).isoformat() if cell.tzinfo else cell.isoformat()
    if isinstance(cell, time):
        return cell.isoformat()
    if isinstance(cell, timedelta):
        return repr(cell.total_seconds())
    return str(cell).strip()


if __name__ == "__main__":
    write_arrays(_arrays, *sys.argv[1:])
