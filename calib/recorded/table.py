"""The samples of a sensor and of a reference, and the checks that each table of samples must pass."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.model import Array, Slices
from calib.recorded.errors import InputError
from calib.signal.stamps import change_of_rate, kind_of

# Columns of a sensor, and of a reference with the quantity that they hold.
SENSOR = ("time_s", "vx", "vy", "vz")
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
FEWEST_ROWS = 2
FIRST_DATE_S = 1e8  # three years after 1970; no recording that counts from its begin is so long
LAST_S = 1e11  # in the year 5138; a later time is in another unit
MOST_STEP_S = 10.0  # usual step of times beside a reference; samples that are farther apart show no motion
# From these values on, a time without unit counts since 1970, in this part of a second: 1e9 s is the year 2001.
SINCE_1970 = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))


@dataclass(frozen=True, slots=True, eq=False)
class SensorTable:
    """Stamps (n,) in s, indications (n, 3), temperature (n,) in degC or None, all as arrays or on disk.

    `name`: of the file, or "sensor". A row of indications is NaN where one of them is missing. `said`: what was
    guessed, for the user. `unit`: of the indications, "" where nothing tells it.
    """

    name: str
    time_s: Slices
    v: Slices
    temperature_degc: Slices | None = None
    said: tuple[str, ...] = ()
    unit: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceTable:
    """Stamps (n,) in s, channels (n, 1 or 3) of a quantity of calib.signal.instrument in SI units, arrays or on disk.

    `name`: of the file, or "reference". `column` is the first channel's; `header`: where the file names its columns,
    for messages. `said`: what was guessed, for the user. `unit_stated`: whether anybody named the unit of the values.
    """

    name: str
    time_s: Slices
    x: Slices
    quantity: str
    column: str
    header: str = ""
    said: tuple[str, ...] = ()
    unit_stated: bool = False

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(self.x[:1].shape[1])

    @property
    def place(self) -> str:
        """Where its columns are named, for messages."""
        return f"{self.name}, {self.header}" if self.header else self.name


def moment(time_s: float) -> str:
    """A time for messages: in s, or as a date with time of day where it counts since 1970."""
    if time_s < FIRST_DATE_S:
        return f"{time_s:.10g} s"
    return str(np.datetime64(round(1000.0 * time_s), "ms")).replace("T", " ")


def second_of(first: float) -> float:
    """What one unit of a time without unit is in s, by its first value."""
    return next((part for least, part in SINCE_1970 if first >= least), 1.0)


def make_whole(rows: Array, columns: Sequence[str], place: str, first: int = 0) -> None:
    """Write NaN into all channels of a row, columns 1 to 3 of `rows` (n, k), where one of them has no value.

    `first` is the number of the first row. Raises InputError where a time is missing, or where a value is infinite.
    """
    if np.isfinite(rows.sum()):
        return
    wrong = np.isinf(rows)
    wrong[:, 0] |= np.isnan(rows[:, 0])
    if wrong.any():
        row, k = (int(i[0]) for i in np.nonzero(wrong))
        value = float(rows[row, k])
        raise InputError(
            f"{value:g} is not a finite number", "correct the value, or remove the row",
            place=place, row=first + row, column=columns[k], value=value,
        )  # fmt: skip
    rows[np.isnan(rows[:, 1:4]).any(axis=1), 1:4] = np.nan


def check_step(table: SensorTable | ReferenceTable) -> None:
    """Raises InputError where samples that are to show a motion are more than MOST_STEP_S apart."""
    usual_s = float(np.median(np.diff(table.time_s[:ROWS_AT_ONCE])))
    if usual_s > MOST_STEP_S:
        raise InputError(
            f"the times are {usual_s:.4g} s apart, at most {MOST_STEP_S:g} s beside a reference",
            "if they are in ms or in us, state their unit, or convert them to s", place=table.name, value=usual_s,
        )  # fmt: skip


def check_count(whole: int, place: str) -> None:
    """Raises InputError if there are fewer rows with values than two."""
    if whole < FEWEST_ROWS:
        raise InputError(f"there are {whole} rows of data, at least {FEWEST_ROWS} are needed", place=place, value=whole)


def ends_s(time_s: Slices) -> tuple[float, float]:
    """The first and the last of stamps (n,), n >= 1, in s."""
    return float(time_s[:1][0]), float(time_s[len(time_s) - 1 :][0])


def _most_late_s(time_s: Slices) -> float:
    """By how much a stamp may be earlier than the previous one."""
    try:
        return 0.0 if kind_of(np.asarray(time_s[:ROWS_AT_ONCE])) == "grid" else LATEST_STAMP_S
    except ValueError:
        return 0.0


def _digits(time_s: float) -> str:
    return f"{time_s:.{10 if abs(time_s) < FIRST_DATE_S else 16}g}"


def _in_order(time_s: float, before_s: float) -> str:
    """What to do where a time follows a later one. Sorting would spoil ms that are written without leading zeros."""
    remedy = "time must not decrease, sort or cut the samples"
    within = math.floor(time_s) == math.floor(before_s)
    return remedy + "; where 5 ms are written as .5, do not sort, but write .005" * within


def check_time(time_s: Slices, column: str, place: str) -> None:
    """Check that time increases, at one rate. Stamps may decrease by LATEST_STAMP_S, but not on an exact grid.

    Raises InputError.
    """
    ends = ends_s(time_s)
    if max(map(abs, ends)) > LAST_S:
        raise InputError(
            f"the time runs from {ends[0]:.10g} s to {ends[1]:.10g} s, which is no time since 1970 in s",
            "state its unit, or convert it to s", place=place, column=column, value=ends[0],
        )  # fmt: skip
    newest = -math.inf
    for first in range(0, len(time_s), ROWS_AT_ONCE):
        part = np.asarray(time_s[first : first + ROWS_AT_ONCE])
        if part[0] >= newest and bool((part[1:] >= part[:-1]).all()):
            newest = float(part[-1])
            continue
        before = np.maximum.accumulate(np.append(newest, part))
        newest = float(before[-1])
        wrong = np.flatnonzero(before[:-1] - part > _most_late_s(time_s))
        if len(wrong):
            at = int(wrong[0])
            raise InputError(
                f"{_digits(part[at])} after {_digits(before[at])}", _in_order(part[at], before[at]),
                place=place, row=first + at, column=column, value=float(part[at]),
            )  # fmt: skip
    if not newest > ends[0]:
        raise InputError(
            f"the value is {newest:.10g} in every row", "time must increase", place=place, column=column, value=newest
        )
    change = change_of_rate(time_s)
    if change is not None:
        row, before_hz, after_hz = change
        raise InputError(
            f"the rate changes about here from {before_hz:.4g} Hz to {after_hz:.4g} Hz, and a device's filters with it",
            "cut the file here, and calibrate each part", place=place, row=row, column=column,
        )  # fmt: skip
