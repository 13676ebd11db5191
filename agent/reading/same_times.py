"""Columns of one text that tell the same times: a date and the seconds since the beginning, a clock in ns and in s."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.reading.dialect import Dialect, TableColumn
from agent.reading.source import Array
from calib.recorded.choice import names_time
from calib.recorded.table import FIRST_DATE_S, second_of
from calib.recorded.units import split, unit_of

FEWEST_ROWS = 20  # from which two columns can be told to be alike
RESOLUTIONS = 3  # of the coarsest column, over which the rows must go
FINE = 0.1  # of the step between rows: a resolution that is fine enough, since arrivals are fitted
_FRACTION = re.compile(r"(?:[.,](?P<digits>\d*))?(?:[eE](?P<power>[-+]?\d+))?\D*$")


@dataclass(frozen=True, slots=True)
class _Clock:
    """The times (n,) of a column in s since `first_s`, and their resolution by the digits that are written."""

    part: TableColumn
    first_s: float
    since_s: Array
    resolution_s: float

    def order(self, step_s: float) -> tuple[bool, bool, float]:
        """Dates first if they are fine enough, then the finest ones."""
        fine = self.resolution_s <= FINE * step_s
        return not fine, not (fine and self.first_s > FIRST_DATE_S), self.resolution_s


def same_times(dialect: Dialect, rows: Sequence[Sequence[str]]) -> tuple[TableColumn, ...]:
    """The columns of time in `dialect`, the best one first, where all of them tell the same times in all `rows`; else
    none. Dates are best, since other files may have them too, if they are fine enough for the step between rows.
    """
    named = [p for p in dialect.parts if names_time(p.name, p.unit)]
    if len(named) < 2 or len(rows) < FEWEST_ROWS:
        return ()
    try:
        clocks = sorted((_clock(dialect, part, rows) for part in named), key=lambda clock: clock.resolution_s)
    except ValueError:  # a value is missing or is none, or the order of a date is not known
        return ()
    finest, *others = clocks
    shown = np.ptp(finest.since_s) >= RESOLUTIONS * clocks[-1].resolution_s
    alike = all(np.abs(c.since_s - finest.since_s).max() <= c.resolution_s + finest.resolution_s for c in others)
    step_s = float(np.median(np.diff(finest.since_s)))
    best_first = sorted(clocks, key=lambda clock: clock.order(step_s))
    return tuple(clock.part for clock in best_first) if shown and alike else ()


def time_without_name(rows: Sequence[Sequence[str]]) -> int | None:
    """The place of the time in rows without names: the first column, or the second behind one that counts the rows.
    None where no time rises by equal steps there.
    """
    for place in (1, 0):
        try:
            values = np.array([[float(cell.replace(",", ".")) for cell in row[: place + 1]] for row in rows])
        except (ValueError, IndexError):
            continue
        if len(values) < FEWEST_ROWS:
            return None
        steps = np.diff(values, axis=0)
        written = max(_written(row[place]) for row in rows)
        counted = place == 0 or bool((steps[:, 0] == 1.0).all() and values[0, 0] in (0.0, 1.0))
        even = steps[:, place].min() > 0.0 and np.ptp(steps[:, place]) <= 2.0 * written
        if counted and even and not (place == 0 and (steps == 1.0).all()):
            return place
    return None


def _clock(dialect: Dialect, part: TableColumn, rows: Sequence[Sequence[str]]) -> _Clock:
    """Raises ValueError where a cell is no time."""
    cells = [[row[place] for place in part.places] for row in rows]
    values = np.array([[dialect.number(cell, k) for cell, k in zip(row, part.places, strict=True)] for row in cells])
    if not np.isfinite(values).all():
        raise ValueError(part.name)
    raw = values @ np.array(part.per)
    unit = unit_of(part.unit or split(part.name)[1])
    second = second_of(float(raw[0])) if unit is None else unit.si
    resolution_s = max(float(np.spacing(np.abs(raw).max())), _written(cells[-1][-1]) * part.per[-1]) * second
    return _Clock(part, float(raw[0]) * second, (raw - raw[0]) * second, resolution_s)


def _written(cell: str) -> float:
    """What one unit of the last digit of a number or of a time of day is."""
    found = _FRACTION.search(cell)
    digits = len(found["digits"] or "") if found else 0
    return float(10.0 ** (int((found and found["power"]) or 0) - digits))
