"""Puts axes that come in messages of their own together again, by the times of their samples."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags

Samples = NDArray[np.int32] | NDArray[np.float64]

LONGEST_S = 30.0  # of one axis that waits for the others; also the longest gap that is counted in samples


@dataclass(frozen=True, slots=True, eq=False)
class AlignedSamples:
    """Samples (n, axes) of all axes, the time of the first one, and what lies before it."""

    start_ns: int
    indications: Samples
    flags: BlockFlags
    missing: int


@dataclass(slots=True, eq=False)
class _AxisRun:
    start_ns: int
    samples: Samples


class Alignment:
    """Takes runs of samples of single axes and gives those of all axes together.

    Samples belong together where their times differ by less than half a sample period. Samples that only some axes
    have are counted in `alone`, samples that an axis had already in `repeated`. Memory is bounded by LONGEST_S.
    """

    def __init__(self, axes: int, rate_hz: float) -> None:
        self._period_ns = 1e9 / rate_hz
        self._most = round(LONGEST_S * rate_hz)
        self._axes = axes
        self.alone = self.repeated = 0
        self.restart()

    def restart(self) -> None:
        """Forget all samples that wait; the next ones carry RESTART."""
        self._waiting: list[deque[_AxisRun]] = [deque() for _ in range(self._axes)]
        self._ends_ns: list[float | None] = [None] * self._axes
        self._end_ns: float | None = None

    def add(self, axis: int, start_ns: int, samples: Samples) -> None:
        """Take samples (n,) of one axis; the first one was taken at `start_ns`."""
        end_ns = self._ends_ns[axis]
        behind = 0.0 if end_ns is None else (end_ns - start_ns) / self._period_ns
        if behind > self._most:  # the clock of the sender was set back
            self.restart()
        elif behind > 0.5:
            self.repeated += len(samples)
            return
        self._ends_ns[axis] = start_ns + len(samples) * self._period_ns
        runs = self._waiting[axis]
        runs.append(_AxisRun(start_ns, samples))
        while sum(len(run.samples) for run in runs) > max(self._most, len(samples)):
            self.alone += len(runs.popleft().samples)

    def take(self) -> Iterator[AlignedSamples]:
        """The samples that all axes have, in the order of their times; each part has no gap inside."""
        while all(self._waiting):
            start_ns = max(runs[0].start_ns for runs in self._waiting)
            for runs in self._waiting:
                self._skip(runs, start_ns)
            late_ns = [runs[0].start_ns - start_ns if runs else np.inf for runs in self._waiting]
            if max(late_ns) > 0.5 * self._period_ns:
                continue  # an axis has nothing at this time
            n = min(len(runs[0].samples) for runs in self._waiting)
            columns = [self._first(runs, n) for runs in self._waiting]
            flags, missing = self._before(start_ns)
            self._end_ns = start_ns + n * self._period_ns
            yield AlignedSamples(start_ns, cast(Samples, np.stack(columns, axis=1)), flags, missing)

    def _skip(self, runs: deque[_AxisRun], start_ns: int) -> None:
        """Discard the samples before `start_ns`."""
        while runs and (early := round((start_ns - runs[0].start_ns) / self._period_ns)) > 0:
            n = min(early, len(runs[0].samples))
            self.alone += n
            self._first(runs, n)

    def _first(self, runs: deque[_AxisRun], n: int) -> Samples:
        """Take the first `n` samples of the first run."""
        run = runs[0]
        taken, run.samples = run.samples[:n], run.samples[n:]
        run.start_ns += round(n * self._period_ns)
        if not len(run.samples):
            runs.popleft()
        return taken

    def _before(self, start_ns: int) -> tuple[BlockFlags, int]:
        if self._end_ns is None:
            return BlockFlags.RESTART, 0
        missing = round((start_ns - self._end_ns) / self._period_ns)
        if missing == 0:
            return BlockFlags.NONE, 0
        return (BlockFlags.GAP, missing) if 0 < missing <= self._most else (BlockFlags.RESTART, 0)
