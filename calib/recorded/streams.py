"""The samples of a table as a stream, from which intervals of time are cut. Missing samples are counted."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from calib.model import Slices
from calib.signal.samples import Samples
from calib.signal.stamps import OFF_S, clock_from_stamps, counted
from calib.signal.timing import ClockFit


class TableStream:
    """Consecutive samples of a table, with times from the clock that is fitted to their stamps.

    `name` is the table's, for messages. `time_s` (n,) stamps, `values` (n, C); both may lie on disk.
    """

    def __init__(self, name: str, time_s: Slices, values: Slices) -> None:
        self._name, self._values = name, values
        self.axes = int(values[:1].shape[1])  # number of columns of values
        self.moved_s = 0.0
        self.clock: ClockFit
        self.clock, self._rows, self._numbers = counted(clock_from_stamps(time_s))
        self._fitted = self.clock

    @property
    def _count(self) -> int:
        """Number of samples, the missing ones included."""
        return int(self._numbers[-1]) + len(self._values) - int(self._rows[-1])

    @property
    def span_s(self) -> tuple[float, float]:
        """Time of the first sample, and that of the one that would follow the last."""
        first_s, end_s = self.clock.time_of([0, self._count]).tolist()
        return first_s, end_s

    @property
    def off_s(self) -> list[tuple[float, float]]:
        """From when to when in s nothing was recorded, where that took longer than OFF_S."""
        stop = self._numbers[:-1] + np.diff(self._rows)  # number of the sample that would follow each run
        from_s, to_s = self.clock.time_of(stop - 1), self.clock.time_of(self._numbers[1:])
        long = to_s - from_s > OFF_S
        return list(zip(from_s[long].tolist(), to_s[long].tolist(), strict=True))

    def stretch(self, rate: float, at_s: float) -> None:
        """Change the times of the samples to a scale that runs faster by `rate`, see ClockFit.stretched."""
        self.clock = self.clock.stretched(rate, at_s)

    def move(self, by_s: float) -> None:
        """Make the times of the samples later by `by_s` than the clock that is fitted to their stamps."""
        at = self._fitted
        self.moved_s = by_s
        self.clock = replace(at, knot_time_s=at.knot_time_s + by_s, offset_s=at.offset_s + by_s)

    def cut(self, start_s: float, stop_s: float) -> Samples | None:
        """The samples with start_s <= t < stop_s, a row of NaN for each one that is missing between them; None if there
        are no samples."""
        edges = np.ceil(self.clock.index_of(np.array([start_s, stop_s])))
        first, stop = (int(edge) for edge in np.clip(edges, 0, self._count))
        low, high = np.searchsorted(self._numbers, [first, stop]).tolist()
        runs = slice(max(low - 1, 0), high)  # the others are outside
        ends = np.append(self._rows, len(self._values))[runs.start : high + 1].tolist()
        parts = [
            (max(first, number), min(stop, number + next_row - row), row - number)
            for (row, next_row), number in zip(itertools.pairwise(ends), self._numbers[runs].tolist(), strict=True)
            if max(first, number) < min(stop, number + next_row - row)
        ]
        if not parts:
            return None
        first, stop = parts[0][0], parts[-1][1]
        held = np.full((self.axes, stop - first), np.nan)  # the samples of an axis lie side by side
        for a, b, to_row in parts:
            held[:, a - first : b - first] = self._values[a + to_row : b + to_row].T
        return Samples(self._name, first, held.T, self.clock)
