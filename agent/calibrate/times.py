"""The times of a file in s: units, days of spreadsheets, counters that wrap, clocks that begin anew."""

from __future__ import annotations

import math
import re

import numpy as np

from agent.reading.source import Array, Source, TableError
from calib.recorded.choice import ChosenColumn, words
from calib.recorded.table import LATEST_STAMP_S, second_of
from calib.recorded.units import unit_of

DAY_S = 86400.0
# Days since 1899-12-30 (Excel) and since the year 0 (MATLAB's datenum), which a time without unit may count: those of
# the years 1990 to 2100. One such day is 1970-01-01.
SERIAL_DAYS = {"Excel": ((32874.0, 73051.0), 25569.0), "MATLAB": ((726834.0, 767011.0), 719529.0)}
MOST_STEP_D = 5e-5  # of serial days (4 s); s with such a step would be at 20 kHz
COMPACT = (1.97e13, 2.1e13)  # YYYYMMDDhhmmss as a number
# Clocks that begin anew, in s: times of day, with and without AM and PM; minutes, or the hour that summer time repeats.
CLOCKS_S = {
    86400.0: "the time of day passes midnight",
    43200.0: "the clock of 12 hours begins anew",
    3600.0: "the time goes back by an hour, as at the end of summer time, or where no hours are written",
}
COUNTERS_BITS = (16, 24, 31, 32)
PARTS = (1.0, 1e-3, 1e-6)  # of a second, which a counter may have counted before it was written in s
MOST_LOST, MOST_LOST_S = 10.0, 30.0  # usual steps, and s, that may be lost where a clock begins anew
RESTART_S, PAUSE_S = 1.0, 10.0  # a restart is later than that after 0; a piece follows the one before after this pause
FEWEST_BEFORE_S, FEWEST_BEFORE = 2.0, 50  # what a piece lasts before a restart, and its rows; less is disorder
LONG = frozenset(("min", "mins", "minutes", "h", "hours", "days"))  # units that end the name of a time: time_min
_BRACKETS = re.compile(r"[\[(]([A-Za-z][^\])]*)[\])]")
# Units in which devices count, in s; one is taken where the rate in the head tells it within a hundredth.
TICKS = {1e-3: "ms", 1e-4: "0.1 ms", 1e-6: "us", 1e-7: "0.1 us", 1e-9: "ns"}
RATE_WITHIN = 0.01
SLOW_S, FAST_S = 0.5, 2e-6  # usual steps beyond which another unit is meant


class Times:
    """The times in the column `chosen` of a file. Raises TableError where its unit is none of time.

    `restart`: where the time begins anew, "" where it does not.
    """

    def __init__(self, source: Source, chosen: ChosenColumn) -> None:
        self._source, self._name = source, str(chosen.column)
        self._guessed: list[str] = []
        unit = unit_of(chosen.unit) if chosen.unit else None
        if unit is not None and unit.quantity != "time":
            raise TableError(
                f"{source.path}, {source.header}: column {self._name!r} is in {chosen.unit}, which is no unit of time"
            )
        if unit is None and LONG & {word := (words(chosen.column.name) or [""])[-1]}:
            unit = unit_of(word)
            self._guessed.append(f"{source.path}: the times of column {self._name!r} are taken in {word}")
        counted = source.rate_hz if chosen.column.name == source.counted else None
        self._guesses = not counted and unit is None
        self._second = 1.0 / counted if counted else 1.0 if unit is None else unit.si  # what one unit is in s
        self._origin = 0.0
        self._first = self._last = math.nan
        self._usual = self._period_s = 0.0  # the usual step, and the mean one in s
        self._shift, self._rows = 0.0, 0
        self._piece = 0  # the row with which the present piece begins
        self._dropped: list[int] = []
        self._told: dict[str, tuple[str, int]] = {}
        self.restart = ""

    def timed(self, rows: Array) -> Array:
        """The rows (n, k) that have a time, the first column."""
        missing = np.isnan(rows[:, 0])
        first = self._rows + len(self._dropped)
        if not missing.any():
            return rows
        self._dropped += (first + np.flatnonzero(missing)).tolist()
        return rows[~missing]

    def place(self, row: int) -> str:
        """Where the file has row `row`, counted without those that have no time."""
        for dropped in self._dropped:
            if dropped > row:
                break
            row += 1
        return self._source.place(row)

    def seconds(self, raw: Array) -> Array:
        """The next times (n,) in s. They go on where a clock begins anew."""
        if not len(raw):
            return raw
        if math.isnan(self._first):
            self._begin(raw)
        shifts = self._shifts(raw)
        self._last, self._rows = float(raw[-1]), self._rows + len(raw)
        moved = raw - self._origin if shifts is None else raw - self._origin + shifts
        return np.asarray(moved * self._second)

    def messages(self) -> list[str]:
        """What was guessed, for the user."""
        told = [f"{where}: {kind}" + (f" ({n} times)" if n > 1 else "") for kind, (where, n) in self._told.items()]
        if self._dropped:
            where = self._source.place(self._dropped[0])
            told.append(f"{self._source.path}, {where}: rows without a time: {len(self._dropped)}; they are gaps")
        return [*self._guessed, *told, *self._odd_rate()]

    def _begin(self, raw: Array) -> None:
        """Find the unit and the usual step by the first times."""
        steps = np.diff(raw)
        self._first = self._last = float(raw[0])
        forward = steps[steps > 0]
        self._usual = float(np.median(forward)) if len(forward) else 0.0
        if self._guesses:
            self._guess_unit()
        self._period_s = float(forward.sum()) / max(len(steps), 1) * self._second

    def _guess_unit(self) -> None:
        path, first, rate_hz = self._source.path, self._first, self._source.rate_hz
        self._second = second_of(first)
        by_rate = [unit for unit in TICKS if rate_hz and abs(rate_hz * self._usual * unit - 1.0) < RATE_WITHIN]
        if by_rate and self._second == 1.0:
            self._second = by_rate[0]
            self._guessed.append(
                f"{path}: the times of column {self._name!r} are {self._usual:.4g} apart, and the head states "
                f"{rate_hz:g} Hz; they are taken in {TICKS[self._second]}"
            )
            return
        if COMPACT[0] < first < COMPACT[1]:
            raise TableError(
                f"{path}, {self._source.place(0)}, column {self._name}: {first:.0f} is a date without marks, and no "
                "number of s; write it as 2023-11-14 22:13:20"
            )
        for program, ((least, most), origin) in SERIAL_DAYS.items():
            if least < first < most and 0.0 < self._usual < MOST_STEP_D:
                self._second, self._origin = DAY_S, origin
                self._guessed.append(
                    f"{path}: column {self._name!r} is taken as days of {program}; state its unit where it is another, "
                    f"as time={self._name}:s"
                )
        if (unknown := _BRACKETS.search(self._name)) and self._origin == 0.0:
            self._guessed.append(
                f"{path}: the unit {unknown[1]!r} of column {self._name!r} is not known; it is taken as s"
            )

    def _shifts(self, raw: Array) -> Array | None:
        """By how much each time is later than the file writes it, None where none is."""
        before = np.append(self._last, raw[:-1])
        back = np.flatnonzero(before - raw > LATEST_STAMP_S / self._second)
        if not len(back) and not self._shift:
            return None
        jumps = np.zeros(len(raw))
        for row in back.tolist():
            jumps[row] = self._jump(float(before[row]), float(raw[row]), self._rows + row)
            if not jumps[row]:  # disorder, which is refused; the times are told as the file has them
                return None
        shifts = self._shift + np.cumsum(jumps)
        self._shift = float(shifts[-1])
        return shifts

    def _jump(self, before: float, after: float, row: int) -> float:
        """By how much times are later from a row on, whose time is earlier than the one before; 0 for disorder."""
        most = min(MOST_LOST * self._usual, MOST_LOST_S / self._second)
        anew = after <= 2.0 * self._usual and self._first <= 2.0 * self._usual  # both as a count from 0
        for clock_s, kind in CLOCKS_S.items():
            if not anew and 0.0 <= after + clock_s / self._second - before <= most:
                self._tell(f"{kind}; the times go on", row, before, after)
                return clock_s / self._second
        for bits in COUNTERS_BITS:
            for part in PARTS if self._second == 1.0 else (1.0,):
                size = 2**bits * part
                if any(0.0 < end - before <= most and 0.0 <= after - end + size <= most for end in (size, size / 2)):
                    self._tell(f"a counter of {bits} bits begins anew; the times go on", row, before, after)
                    return float(size)
        lasted_s, lasted = (before - after) * self._second, row - self._piece
        if 0.0 <= after * self._second <= RESTART_S and lasted_s >= FEWEST_BEFORE_S and lasted >= FEWEST_BEFORE:
            self._piece = row
            told = "the time begins anew"
            self._tell(f"{told}; the pieces are taken with {PAUSE_S:g} s between them", row, before, after)
            where = f"{self._source.path}, {self.place(row)}, column {self._name}"
            self.restart = self.restart or f"{where}: {told} at {after:.10g} after {before:.10g}"
            return before - after + PAUSE_S / self._second
        return 0.0

    def _tell(self, kind: str, row: int, before: float, after: float) -> None:
        where, count = self._told.get(kind, ("", 0))
        where = (
            where or f"{self._source.path}, {self.place(row)}, column {self._name}: {after:.10g} after {before:.10g}"
        )
        self._told[kind] = where, count + 1

    def _odd_rate(self) -> list[str]:
        """What tells that the times are in another unit than they are taken in."""
        rate_hz, source = self._source.rate_hz, self._source
        if self._period_s <= 0.0:
            return []
        told = f"{source.path}: the times of column {self._name!r} are {self._period_s:.4g} s apart"
        state = f"state their unit where it is not s, as time={self._name}:ms"
        if rate_hz and not 0.5 < rate_hz * self._period_s < 2.0:
            return [f"{told}, and the head states {rate_hz:g} Hz; {state}"]
        return [f"{told}; {state}"] if not FAST_S < self._period_s < SLOW_S else []
