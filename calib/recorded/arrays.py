"""Tables and poses from arrays: DataFrames, dicts of columns, structured or two-dimensional arrays, pairs.

A DataFrame is anything with `columns` that gives a column by its name, so no library of DataFrames is imported.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from calib.model import Array
from calib.recorded.choice import Choice, ChosenColumn, Column
from calib.recorded.columns import in_the_first_unit, reference_columns, sensor_columns, si_of
from calib.recorded.errors import InputError
from calib.recorded.poses import AXIS, SPAN, PoseRow, Poses, columns_of
from calib.recorded.table import (
    REFERENCES,
    SENSOR,
    ReferenceTable,
    SensorTable,
    check_count,
    check_time,
    make_whole,
    second_of,
)
from calib.recorded.units import unit_of

REFERENCE_HEADERS = " | ".join(",".join(("time_s", *names)) for names in REFERENCES)
BY_QUANTITY = {quantity: names for names, quantity in REFERENCES.items()}  # the last of a quantity: one channel
NS = 1e-9


class _Frame:
    """The columns of a table in memory, as Choice reads them. Dates are in s since 1970."""

    def __init__(self, place: str, columns: Mapping[Any, Any]) -> None:
        dated = {name: _filled(values).dtype.kind in "Mm" for name, values in columns.items()}
        self.path, self.header, self.remedy = place, "", ""
        self.repeated: Sequence[Column] = ()
        self.columns: Sequence[Column] = [Column(str(name), "s" if is_date else "") for name, is_date in dated.items()]


def sensor_table(given: Any) -> SensorTable:
    """The samples of a sensor, in the unit of the table; where it has several, in that of x. Raises InputError."""
    place = "sensor"
    columns = _columns(given, SENSOR, place)
    if "time_s" in columns and set(SENSOR[1:]) & set(columns):
        rows = _rows([(name, _column(columns, name, place)) for name in SENSOR], place)
        return SensorTable(place, rows[:, 0], rows[:, 1:])
    choice = Choice(_Frame(place, columns))
    chosen = sensor_columns(choice)[:4]
    unit, scale = in_the_first_unit(choice, chosen[1:])
    rows = _chosen_rows(columns, chosen, np.array(scale), place)
    return SensorTable(place, rows[:, 0], rows[:, 1:], None, tuple(choice.said), unit)


def reference_table(given: Any, quantity: str | None) -> ReferenceTable:
    """The samples of a reference in SI units. `quantity` is for arrays without names of columns. Raises InputError."""
    place = "reference"
    width = _width(given)
    unnamed = ("time_s", *(BY_QUANTITY[quantity or "acceleration"] if width == 2 else ("ax", "ay", "az")))
    columns = _columns(given, unnamed, place)
    there = [names for names in REFERENCES if set(names) & set(columns)]
    if "time_s" in columns and there:
        if len(there) > 1:
            raise InputError(
                f"the columns are {', '.join(map(str, columns))}", f"give one of {REFERENCE_HEADERS}",
                place=place, value=tuple(columns),
            )  # fmt: skip
        names = there[0]
        rows = _rows([(name, _column(columns, name, place)) for name in ("time_s", *names)], place)
        return ReferenceTable(place, rows[:, 0], rows[:, 1:], REFERENCES[names], names[0])
    choice = Choice(_Frame(place, columns))
    chosen, found = reference_columns(choice, None)
    scale = np.array([si_of(choice, each, None) for each in chosen[1:]])
    rows = _chosen_rows(columns, chosen, scale, place)
    column, stated = str(chosen[1].column), all(each.unit for each in chosen[1:])
    return ReferenceTable(place, rows[:, 0], rows[:, 1:], found, column, "", tuple(choice.said), stated)


def poses_of(given: Any) -> Poses:
    """Poses from a table, or from a sequence with a dict for each pose. Raises InputError."""
    place = "poses"
    columns = _columns(_transposed(given, place), (), place)
    header = [str(name) for name in columns]
    names = [*SPAN, *columns_of(header, place)]
    values = {name: _column(columns, name, place) for name in names}
    axis = list(values.pop(AXIS[0])) if AXIS[0] in values else None
    numbers = {name: _numbers(column, place, name) for name, column in values.items()}
    for name, column in numbers.items():
        if len(wrong := np.flatnonzero(~np.isfinite(column))):
            value = float(column[wrong[0]])
            raise InputError(
                f"{value} is not a finite number", "correct the value", place=place, row=int(wrong[0]), column=name,
                value=value,
            )  # fmt: skip
    stated = [name for name in numbers if name not in SPAN]
    rows = [
        PoseRow(
            float(numbers[SPAN[0]][k]), float(numbers[SPAN[1]][k]), {name: float(numbers[name][k]) for name in stated},
            None if axis is None else str(axis[k]),
        )
        for k in range(len(numbers[SPAN[0]]))
    ]  # fmt: skip
    return Poses(place, rows)


def _transposed(given: Any, place: str) -> Any:
    """A sequence of dicts as a dict of columns; anything else as it is."""
    if isinstance(given, Mapping) or hasattr(given, "columns") or not isinstance(given, Sequence):
        return given
    if not all(isinstance(row, Mapping) for row in given):
        raise InputError("a pose is no dict", "give a DataFrame, or a list with a dict for each pose", place=place)
    names = list(given[0]) if given else list(SPAN)
    for k, row in enumerate(given):
        if missing := [name for name in (*names, *SPAN) if name not in row]:
            raise InputError("it is missing", "give each pose the same columns", place=place, row=k, column=missing[0])
    return {name: [row[name] for row in given] for name in names} if given else {name: [] for name in (*SPAN, *AXIS)}


def _width(given: Any) -> int | None:
    """Number of columns of what has no names: time and values. None where the columns have names."""
    if isinstance(given, tuple) and len(given) == 2:
        return 2 if np.ndim(given[1]) == 1 else 1 + np.shape(given[1])[-1]
    if isinstance(given, np.ndarray) and given.dtype.names is None and given.ndim == 2:
        return int(given.shape[1])
    return None


def _columns(given: Any, unnamed: Sequence[str], place: str) -> dict[Any, Any]:
    """The columns by their names; `unnamed` are the names of columns that have none. Raises InputError."""
    if isinstance(given, Mapping):
        return dict(given)
    if hasattr(given, "columns"):
        return {name: given[name] for name in given.columns}
    if isinstance(given, np.ndarray) and given.dtype.names is not None:
        return {name: given[name] for name in given.dtype.names}
    width = _width(given)
    if width is None or not unnamed:
        raise InputError(
            f"{type(given).__name__} is no table", "give a DataFrame, a dict of columns or an array", place=place
        )
    if width != len(unnamed):
        raise InputError(
            f"there are {width} columns", f"give {len(unnamed)}: {', '.join(unnamed)}", place=place, value=width
        )
    if isinstance(given, tuple):
        time, values = given
        values = _filled(values)
        return dict(zip(unnamed, [time, *(values.T if values.ndim == 2 else [values])], strict=True))
    return dict(zip(unnamed, _filled(given).T, strict=True))


def _column(columns: Mapping[Any, Any], name: str, place: str) -> Any:
    if name not in columns:
        told = ", ".join(map(str, columns))
        raise InputError(f"it is missing; the columns are {told}", "rename a column", place=place, column=name)
    return columns[name]


def _chosen_rows(columns: Mapping[Any, Any], chosen: Sequence[ChosenColumn], scale: Array, place: str) -> Array:
    """The chosen columns as rows (n, k), checked: times in s, the others times `scale` (k - 1)."""
    time = unit_of(chosen[0].unit) if chosen[0].unit else None
    if time is not None and time.quantity != "time":
        problem = f"it is in {chosen[0].unit}, which is no unit of time"
        raise InputError(problem, "rename the column", place=place, column=str(chosen[0].column))
    by_name = {str(name): values for name, values in columns.items()}
    named = [(each.column.name, by_name[each.column.name]) for each in chosen]
    named[0] = (named[0][0], _times(named[0][1]))
    rows = _rows(named, place, None if time is None else time.si)
    rows[:, 1:] *= scale
    return rows


def _rows(columns: Iterable[tuple[str, Any]], place: str, second: float | None = None) -> Array:
    """Columns of time and channels as rows (n, k), checked: times in s. `second`: one unit of the times in s."""
    named = {name: _numbers(values, place, name) for name, values in columns}
    names = list(named)
    length = len(named[names[0]])
    for name, values in named.items():
        if len(values) != length:
            problem = f"there are {len(values)} values, but {length} times"
            raise InputError(problem, "give each sample a time", place=place, column=name)
    rows = np.column_stack(list(named.values()))
    make_whole(rows, names, place)
    check_count(int(np.isfinite(rows[:, 1]).sum()), place)
    rows[:, 0] *= second_of(float(rows[0, 0])) if second is None else second
    check_time(rows[:, 0], names[0], place)
    return rows


def _filled(values: Any) -> np.ndarray[Any, Any]:
    """An array in which masked values are NaN, and dates with a zone are in UTC."""
    if getattr(getattr(values, "dtype", None), "tz", None) is not None:
        return np.asarray(values.to_numpy(dtype="datetime64[ns]"))
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.filled(values.astype(float), np.nan)
    return np.asarray(values)


def _numbers(values: Any, place: str, column: str) -> Array:
    """A column (n,) as floats; dates as seconds since 1970. Raises InputError."""
    found = _filled(values)
    if found.ndim != 1:
        problem = f"it has the shape {found.shape}"
        raise InputError(problem, "give one value for each sample", place=place, column=column)
    if found.dtype.kind == "M":
        return _seconds(found)
    if found.dtype.kind == "m":
        return np.where(np.isnat(found), np.nan, found.astype("timedelta64[ns]").astype(np.int64) * NS)
    try:
        if found.dtype.kind != "c":
            return np.array(found, dtype=np.float64)
    except (TypeError, ValueError):
        pass
    row = next((k for k, value in enumerate(found.tolist()) if not _is_number(value)), 0)
    raise InputError(
        f"{found[row]!r} is no number", "correct the value, or remove the row; give dates as datetime64", place=place,
        row=row, column=column, value=found[row],
    )  # fmt: skip


def _seconds(dates: np.ndarray[Any, Any]) -> Array:
    """Dates (n,) as seconds since 1970, UTC."""
    ns = dates.astype("datetime64[ns]").astype(np.int64)
    return np.where(np.isnat(dates), np.nan, ns // 10**9 + (ns % 10**9) * NS)


def _times(values: Any) -> Any:
    """Dates that are still text (ISO 8601, without a zone in UTC) as datetime64; anything else as it is."""
    found = _filled(values)
    if found.dtype.kind not in "OUT" or not len(found) or _is_number(found[0]):
        return values
    try:
        return np.array([str(text).removesuffix("Z").strip() for text in found.tolist()], dtype="datetime64[ns]")
    except ValueError:
        return values


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return value is None
    return True
