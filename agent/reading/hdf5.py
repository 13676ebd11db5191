"""HDF5 files, also those of MATLAB 7.3, by h5py. Nothing outside the file is read: no link, no external storage."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from agent.reading.source import Arrays, Column, Grid, TableError
from calib.model import Slices

MOST_COLUMNS = 16  # of one data set; more are not the axes of a sensor
MOST_OBJECTS = 10_000
DEEPEST = 8
FEWEST_ROWS = 2
RATES = ("fs", "rate_hz", "sample_rate", "samplerate", "sampling_rate", "fsamp")  # names of a sampling rate in Hz


class DatasetColumn:
    """One column of a data set of two dimensions; the longer one counts the samples."""

    def __init__(self, data: Any, column: int) -> None:
        self._data, self._column = data, column
        self._rows_first = data.shape[0] >= data.shape[1]

    def __len__(self) -> int:
        return int(max(self._data.shape))

    def __getitem__(self, rows: slice, /) -> Any:
        return self._data[rows, self._column] if self._rows_first else self._data[self._column, rows]


class Field:
    """One field of a data set of records."""

    def __init__(self, data: Any, name: str) -> None:
        self._data, self._name = data, name

    def __len__(self) -> int:
        return len(self._data)

    def __getitem__(self, rows: slice, /) -> Any:
        return self._data[rows][self._name]


def open_hdf5(path: Path) -> Arrays:
    """Data sets of numbers as columns; a group with data sets is a group. Raises TableError."""
    import h5py

    try:
        with ExitStack() as opened:
            file = opened.enter_context(h5py.File(path, "r"))
            values: dict[Column, Slices] = {}
            for group, name, data in _data_sets(path, file):
                unit = _text(data.attrs.get("units", data.attrs.get("unit", "")))
                values |= columns_of(name, data, unit, group)
            source = Arrays(path, with_times(values, _rates(file)), file.close)
            opened.pop_all()
            return source
    except TableError:
        raise
    except Exception as error:  # h5py raises many kinds for broken files
        reason = str(error).partition("\n")[0]
        raise TableError(f"{path}: the file cannot be read: {reason}; write it anew") from None


def columns_of(name: str, data: Any, unit: str = "", group: str = "") -> dict[Column, Slices]:
    """The columns of an array of numbers: itself, or `name[0]`, `name[1]`, ... of one with two dimensions."""
    if data.dtype.names:
        fields = [
            field for field in data.dtype.names if data.dtype[field].kind in "iuf" and not data.dtype[field].shape
        ]
        return {Column(field, "", name): Field(data, field) for field in fields} if data.ndim == 1 else {}
    if data.dtype.kind not in "iuf" or data.ndim not in (1, 2) or max(data.shape) < FEWEST_ROWS:
        return {}
    if data.ndim == 1:
        return {Column(name, unit, group): data}
    width = min(data.shape)
    if width == 1:
        return {Column(name, unit, group): DatasetColumn(data, 0)}
    return (
        {Column(f"{name}[{k}]", unit, group): DatasetColumn(data, k) for k in range(width)}
        if width <= MOST_COLUMNS
        else {}
    )


def with_times(values: dict[Column, Slices], rates: dict[str, float]) -> dict[Column, Slices]:
    """The columns, and `time_s` in each group of which the sampling rate is known."""
    for group in list(dict.fromkeys(column.group for column in values)):
        rate_hz = rates.get(group, rates.get(group.rpartition("/")[0], 0.0))
        if rate_hz > 0.0 and not any("time" in c.name.lower() or c.name == "t" for c in values if c.group == group):
            longest = max(len(v) for c, v in values.items() if c.group == group)
            values[Column("time_s", "s", group)] = Grid(0.0, rate_hz, longest)
    return values


def _data_sets(path: Path, file: Any) -> Iterator[tuple[str, str, Any]]:
    """Yield the group, the name and the data set of all numbers in the file itself."""
    import h5py

    waiting, seen = [(file, 0)], 0
    while waiting:
        group, depth = waiting.pop()
        for name in group:
            seen += 1
            if seen > MOST_OBJECTS or depth > DEEPEST:
                raise TableError(f"{path}: more than {MOST_OBJECTS} objects, or groups in each other {DEEPEST} times; "
                                 "write only the data sets that are needed")  # fmt: skip
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            thing = group[name]
            if isinstance(thing, h5py.Group):
                waiting.append((thing, depth + 1))
            elif isinstance(thing, h5py.Dataset):
                if thing.external or thing.is_virtual:
                    raise TableError(
                        f"{path}, data set {thing.name}: its values are in another file, which is not read; write them "
                        "into this file"
                    )
                yield group.name.strip("/"), name, thing


def _rates(file: Any) -> dict[str, float]:
    """The sampling rates, by group: an attribute or a data set with one number that is called so."""
    found: dict[str, float] = {}

    def look(name: str, thing: Any) -> None:
        group, _, last = name.rpartition("/")
        if hasattr(thing, "shape"):
            if last.lower() in RATES and thing.size == 1 and thing.dtype.kind in "iuf":
                found[group] = float(np.ravel(thing[()])[0])
        else:
            attributes(name, thing)

    def attributes(name: str, thing: Any) -> None:
        for key, value in thing.attrs.items():
            if key.lower() in RATES and np.size(value) == 1 and np.asarray(value).dtype.kind in "iuf":
                found[name] = float(np.ravel(value)[0])

    attributes("", file)
    file.visititems(look)
    return found


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value if isinstance(value, str) else ""
