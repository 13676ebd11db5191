"""The messages of one publisher in the order of their times, each taken once.

A file can hold them otherwise: files were merged or split, a recorder has several threads, a driver publishes from
several, or publishes again what it has (phidgets_drivers issue 17, zed-ros-wrapper issues 577 and 670).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from agent.reading.source import ROWS_AT_ONCE, Array
from agent.reading.spool import Spool
from calib.recorded.errors import InputError
from calib.recorded.table import check_time
from calib.signal.stamps import kind_of

LONG_RUN = 100  # messages
MOST_CHANGES = 20  # of the run, for each long run, where runs only overlap at their ends
TIME, LOGGED, CHECK = 0, -2, -1  # columns


class PublisherStream:
    """The messages of one publisher on disk. A row: its time in s, its numbers, when it was recorded, and a checksum.

    `moved`: messages that do not stand in the order of their times; `doubled`: messages that are there again. Both are
    known after `rows`.
    """

    def __init__(self, numbers: int) -> None:
        self._spool = Spool(numbers + 2)
        self.moved = self.doubled = 0

    def append(self, rows: Array) -> None:
        """Add messages (n, numbers + 2)."""
        self._spool.append(rows)

    def rows(self) -> Iterator[Array]:
        """Yield the time and the numbers in order, without what is there again.

        A message is there again if time, numbers and bytes are the same. Where a driver gives several samples one
        time, equal samples are nothing unusual: then it must have been recorded at the same time too.
        """
        order = self._order()
        bursts = any((_equal_rows(rows, before, [TIME]) & ~_equal_rows(rows, before, [CHECK])).any()
                     for rows, before in self._pairs(order))  # fmt: skip
        told = [k for k in range(self._spool.width) if bursts or k != self._spool.width + LOGGED]
        self.doubled = 0
        for rows, before in self._pairs(order):
            again = _equal_rows(rows, before, told)
            self.doubled += int(again.sum())
            yield rows[~again, :LOGGED]

    def _order(self) -> NDArray[np.intp] | None:
        """The numbers of the rows in the order of their times; None where it is that of the file.

        Rows are sorted by when they were recorded and, if their times are then still no times of samples, by these:
        times on an exact grid must not decrease at all, others may be late. Where neither helps, as after a clock that
        was set back, they stay as they are, and the caller refuses their times.
        """
        self.moved = 0
        if self._increases():
            return None
        time_s, logged = (self._column(k) for k in (TIME, LOGGED))
        exact = _are_exact(np.sort(time_s))
        for keys in ((logged,), (logged, time_s)):
            order = np.lexsort(keys)
            increase = bool((np.diff(time_s[order]) >= 0.0).all())
            if (increase or (not exact and _is_usable(time_s[order]))) and not self._mixes(order, time_s):
                self.moved = int((np.diff(order) < 0).sum())
                return order if self.moved else None
        return None

    def _increases(self) -> bool:
        newest = -np.inf
        for first in range(0, self._spool.rows, ROWS_AT_ONCE):
            times = self._spool.read(first, min(first + ROWS_AT_ONCE, self._spool.rows))[:, TIME]
            if times[0] < newest or (np.diff(times) < 0.0).any():
                return False
            newest = times[-1]
        return True

    def _column(self, k: int) -> Array:
        parts = range(0, self._spool.rows, ROWS_AT_ONCE)
        return np.concatenate([self._spool.read(i, min(i + ROWS_AT_ONCE, self._spool.rows))[:, k] for i in parts])

    def _mixes(self, order: NDArray[np.intp], time_s: Array) -> bool:
        """Whether sorting mixes long runs of the file that are not the same messages: a clock was set back."""
        run = np.concatenate([[0], np.cumsum(np.diff(time_s) < 0.0)])
        is_long = np.bincount(run) >= LONG_RUN
        check = self._column(CHECK)[order]
        first = np.concatenate([[True], (np.diff(time_s[order]) != 0.0) | (np.diff(check) != 0.0)])
        runs = run[order][first]
        runs = runs[is_long[runs]]
        return int((np.diff(runs) != 0).sum()) > MOST_CHANGES * int(is_long.sum())

    def _pairs(self, order: NDArray[np.intp] | None) -> Iterator[tuple[Array, Array]]:
        """Yield rows in order, and for each row the one before it; NaN before the first."""
        last = np.full((1, self._spool.width), np.nan)
        for first in range(0, self._spool.rows, ROWS_AT_ONCE):
            stop = min(first + ROWS_AT_ONCE, self._spool.rows)
            rows = self._spool.read(first, stop) if order is None else self._spool.take(order[first:stop])
            yield rows, np.concatenate([last, rows[:-1]])
            last = rows[-1:]


def _equal_rows(rows: Array, before: Array, columns: list[int]) -> NDArray[np.bool_]:
    """Which rows have the same bytes as those before, in these columns."""
    a, b = (np.ascontiguousarray(each[:, columns]).view(np.uint64) for each in (rows, before))
    return np.asarray((a == b).all(axis=1))


def _are_exact(time_s: Array) -> bool:
    """Whether times (n,) that increase are on a grid, but for gaps and for times that are there twice."""
    try:
        return kind_of(np.unique(time_s)[:ROWS_AT_ONCE]) == "grid"
    except ValueError:
        return False


def _is_usable(time_s: Array) -> bool:
    try:
        check_time(time_s, "", "")
    except InputError:
        return False
    return True
