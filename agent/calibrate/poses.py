"""Reads poses.csv."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from agent.calibrate.faults import as_table_error
from agent.reading.delimited import fields_of, number_of
from agent.reading.dialect import Dialect, dialect_of, lines_of
from agent.reading.source import TableError
from calib.recorded.poses import AXIS, SPAN, PoseRow, Poses, columns_of
from calib.recorded.units import SUFFIXES


class PosesFile:
    """The poses of a file, as they are stated: `poses`. Without a file it is None.

    Raises TableError.
    """

    def __init__(self, path: Path | None, date_order: str | None = None) -> None:
        self.poses: Poses | None = None
        self._lines: list[int] = []
        if path is not None:
            self._read(path, date_order or "")

    @classmethod
    def of_metadata(cls, poses: Poses) -> PosesFile:
        """Poses that another file states than poses.csv."""
        found = cls(None)
        found.poses = poses
        return found

    def _read(self, path: Path, date_order: str) -> None:
        dialect = dialect_of(path, date_order)
        lines = [(number, dialect.fields(line)) for number, line in lines_of(path, dialect)]
        header = dialect.header
        _require(path, dialect, SPAN)
        with as_table_error():
            names = [*SPAN, *columns_of(header, f"{path}, line {dialect.header_line}")]
        _require(path, dialect, names)
        self._lines = [line for line, _ in lines]
        rows = [_row(path, line, dialect, fields_of(path, line, row, header), names) for line, row in lines]
        with as_table_error(self.line):
            self.poses = Poses(str(path), rows)

    def line(self, row: int) -> str:
        """The place of a row, for messages."""
        return f"line {self._lines[row]}" if self._lines else f"row {row}"


def _row(path: Path, line: int, dialect: Dialect, fields: Sequence[str], names: Sequence[str]) -> PoseRow:
    places = {name: dialect.header.index(name) for name in names}
    axis = fields[places.pop(AXIS[0])] if AXIS[0] in places else None
    values = {name: number_of(path, line, dialect, k, fields[k]) for name, k in places.items()}
    for name, value in values.items():
        if math.isnan(value):
            raise TableError(f"{path}, line {line}, column {name}: {fields[places[name]]!r} is not a finite number")
    return PoseRow(values.pop(SPAN[0]), values.pop(SPAN[1]), values, axis)


def _require(path: Path, dialect: Dialect, names: Sequence[str]) -> None:
    """Check that all columns are there once. Raises TableError."""
    where = f"{path}, line {dialect.header_line}"
    header = dialect.header
    if len(set(header)) < len(header):
        raise TableError(f"{where}: a column is there twice, remove one: {','.join(header)!r}")
    for name in names:
        if name not in header:
            stem = name.rsplit("_", 1)[0]
            others = [n for n in header if n.rsplit("_", 1)[0] == stem and n.rpartition("_")[2] in {*SUFFIXES, "rad"}]
            hint = f"; {others[0]} has another unit, convert it" if others else ""
            raise TableError(f"{where}: column {name} is missing in the header {','.join(header)!r}{hint}")
