"""Reads sensor.csv and reference.csv fast, also files larger than memory. Every fault is reported with its place."""

from __future__ import annotations

import io
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from agent.calibrate.decimals import decimals
from agent.config.files import open_file
from calib.signal.stamps import kind_of

Array = NDArray[np.float64]
Progress = Callable[[int], Any]  # called with the number of bytes that were just read

CHUNK_BYTES = 1 << 18  # fits into the second-level cache while it is parsed
LARGEST = 1e15  # no indication or time is larger, and its squares and their sums stay finite
SENSOR = ("time_s", "vx", "vy", "vz")
TEMPERATURE = "temperature_degc"
# Columns of a reference, and the quantity that they hold.
REFERENCES = {
    ("ax", "ay", "az"): "acceleration",
    ("a",): "acceleration",
    ("v",): "velocity",
    ("d",): "displacement",
}
# A stamp may be earlier than the previous one by up to this time, because of jitter or a burst that was read late
# (delays are some tens of ms).
LATEST_STAMP_S = 0.1
ROWS_AT_ONCE = 1 << 20


class TableError(Exception):
    """The file cannot be used. The message names file, line, column and value."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorTable:
    """sensor.csv: stamps (n,) in s, indications (n, 3), temperature (n,) in degC or None. The arrays are on disk."""

    path: Path
    time_s: Array
    v: Array
    temperature_degc: Array | None


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceTable:
    """reference.csv: stamps (n,) in s, channels (n, 1 or 3) of a quantity of calib.signal.instrument in SI units.

    `column` names the first channel in the header.
    """

    path: Path
    time_s: Array
    x: Array
    quantity: str
    column: str


def read_sensor(path: Path, progress: Progress | None = None) -> SensorTable:
    """Read sensor.csv. Raises TableError."""
    with open_table(path) as file:
        header = header_of(path, file)
        require(path, header, SENSOR)
        names = [*SENSOR, TEMPERATURE] if TEMPERATURE in header else [*SENSOR]
        rows = _columns(path, file, header, names, progress)
    _check_time(path, rows[:, 0])
    return SensorTable(path, rows[:, 0], rows[:, 1:4], rows[:, 4] if len(names) > 4 else None)


def read_reference(path: Path, progress: Progress | None = None) -> ReferenceTable:
    """Read reference.csv: `a`, `v` or `d` alone, or `ax,ay,az`. Raises TableError."""
    with open_table(path) as file:
        header = header_of(path, file)
        found = [names for names in REFERENCES if set(names) <= set(header)]
        if len(found) != 1:
            wanted = ", ".join(f"time_s,{','.join(names)}" for names in REFERENCES)
            raise TableError(f"{path}, line 1: expected exactly one of {wanted}; the header is {','.join(header)!r}")
        require(path, header, ("time_s", *found[0]))
        rows = _columns(path, file, header, ["time_s", *found[0]], progress)
    _check_time(path, rows[:, 0])
    return ReferenceTable(path, rows[:, 0], rows[:, 1:], REFERENCES[found[0]], found[0][0])


def open_table(path: Path) -> IO[bytes]:
    """The file, opened. Raises TableError."""
    try:
        return open_file(path)
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from None


def header_of(path: Path, file: IO[bytes]) -> list[str]:
    """Column names in the first line. Raises TableError."""
    line = file.readline()
    try:
        header = [name.strip() for name in line.decode("utf-8-sig").split(",")]
    except UnicodeDecodeError:
        raise TableError(f"{path}, line 1: the line is not UTF-8 text") from None
    if len(set(header)) < len(header):
        raise TableError(f"{path}, line 1: a column is there twice, remove one: {','.join(header)!r}")
    return header


def require(path: Path, header: Sequence[str], names: Sequence[str]) -> None:
    """Check that all columns are there, and none of them also in another unit (time_ms, ax_g). Raises TableError."""
    for name in names:
        base = name.rsplit("_", 1)[0]
        others = [n for n in header if n.isidentifier() and n.rsplit("_", 1)[0] == base and n not in names]
        if name not in header:
            hint = f"; {others[0]} has another unit, convert it" if others else ""
            raise TableError(f"{path}, line 1: column {name} is missing in the header {','.join(header)!r}{hint}")
        if others:
            raise TableError(
                f"{path}, line 1: the header has both {name} and {others[0]}; remove the one with the wrong unit"
            )


def _columns(
    path: Path, file: IO[bytes], header: Sequence[str], names: Sequence[str], progress: Progress | None
) -> Array:
    """The named columns (n, k) of all further lines, n >= 2.

    A temporary file on disk holds them while they are used.
    """
    places = [header.index(name) for name in names]
    line, rest = 2, b""
    with tempfile.TemporaryFile() as spool:
        while data := file.read(CHUNK_BYTES):
            text, rest = _whole_lines(rest + data)
            line += _append(spool, path, line, text, header, places)
            if progress is not None:
                progress(len(data))
        line += _append(spool, path, line, rest.rstrip(b"\r\n") + b"\n" if rest.strip() else b"", header, places)
        if line < 4:
            raise TableError(f"{path}: the file has {line - 2} rows of data, at least 2 are needed")
        spool.flush()
        return np.asarray(np.memmap(spool, dtype=np.float64, mode="r", shape=(line - 2, len(places))))


def _whole_lines(data: bytes) -> tuple[bytes, bytes]:
    """Whole lines, and the rest. Blank lines stay in the rest, because they may be the end of the file."""
    end = data.rstrip(b"\r\n")
    cut = end.rfind(b"\n") + 1
    whole = data[:cut]
    return whole.replace(b"\r\n", b"\n") if b"\r" in whole else whole, data[cut:]


def _append(spool: IO[bytes], path: Path, line: int, text: bytes, header: Sequence[str], places: Sequence[int]) -> int:
    """Parse whole lines, of which the first has the number `line`, and append their columns.

    Gives the number of lines.
    """
    if not text:
        return 0
    rows = decimals(text, len(header))
    if rows is None:
        rows = _rows(path, line, text, header)
    spool.write(np.ascontiguousarray(rows[:, places]).data)
    return len(rows)


def _rows(path: Path, first_line: int, text: bytes, header: Sequence[str]) -> Array:
    """Parse numbers in any notation. Raises TableError for the first line that is wrong."""
    try:
        rows = np.loadtxt(io.BytesIO(text), delimiter=",", comments=None, ndmin=2)
    except ValueError:
        rows = np.empty((0, 0))
    if rows.shape == (text.count(b"\n"), len(header)) and (np.abs(rows) <= LARGEST).all():
        return rows
    parsed = []
    for line, content in enumerate(text.decode("utf-8", "replace").splitlines(), start=first_line):
        fields = fields_of(path, line, content.split(","), header)
        parsed.append([number_of(path, line, name, field) for name, field in zip(header, fields, strict=True)])
    return np.array(parsed)


def fields_of(path: Path, line: int, fields: list[str], header: Sequence[str]) -> list[str]:
    """The fields without blanks around them. Raises TableError if their number is not that of the header."""
    if len(fields) != len(header):
        raise TableError(f"{path}, line {line}: {len(fields)} fields, but the header has {len(header)}")
    return [field.strip() for field in fields]


def number_of(path: Path, line: int, column: str, text: str) -> float:
    """A finite number that is not larger than LARGEST. Raises TableError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise TableError(f"{path}, line {line}, column {column}: {text.strip()!r} is not a finite number")
    if abs(value) > LARGEST:
        raise TableError(f"{path}, line {line}, column {column}: {text.strip()!r} is larger than {LARGEST:g}")
    return value


def _check_time(path: Path, time_s: Array) -> None:
    """Check that time increases. Stamps may decrease by LATEST_STAMP_S, but not if they are on an exact grid.

    Raises TableError.
    """
    try:
        allowed = 0.0 if kind_of(np.asarray(time_s[:ROWS_AT_ONCE])) == "grid" else LATEST_STAMP_S
    except ValueError:
        allowed = 0.0
    newest = -math.inf
    for first in range(0, len(time_s), ROWS_AT_ONCE):
        part = np.asarray(time_s[first : first + ROWS_AT_ONCE])
        before = np.maximum.accumulate(np.append(newest, part))
        newest = float(before[-1])
        wrong = np.flatnonzero(before[:-1] - part > allowed)
        if len(wrong):
            at = int(wrong[0])
            later = f"{part[at]:.10g} after {before[at]:.10g}"
            raise TableError(f"{path}, line {first + at + 2}, column time_s: {later}; time must not decrease")
    if not newest > float(time_s[0]):
        raise TableError(f"{path}, column time_s: the value is {newest:.10g} in every line; time must increase")
