"""Generalised likelihood ratio of a change, for many possible onsets of it (Willsky and Jones 1976).

The score s of a window for a parameter is standard normal as long as nothing changes; a change d moves its mean by
d sqrt(I), where I is the information of the window. For a step that began with window j, the log of the likelihood
ratio against no change is (sum sqrt(I) s)^2 / (2 sum I) over the windows since j, and its size is
(sum sqrt(I) s) / (sum I). A ramp that began with window j has sqrt(I) (t - t_j) in place of sqrt(I). The sums are kept
for each onset. Older onsets are kept less densely (eight per octave of age), so that time and memory are bounded; the
oldest one is `SPAN` windows old.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.model import Array

DENSE = 8  # windows: all younger onsets are kept; an onset that is not kept reduces the statistic by at most 1/16
SPAN = 16384  # windows: almost two years with one window per hour
# For the test, but not for sizes, larger scores are reduced to this value. With two windows the statistic is then
# CLIP^2 at most (Cauchy-Schwarz), so a threshold of CLIP^2 or more needs at least three windows that agree. Without a
# change, one score in 2000 is larger.
CLIP = 3.5
LEAST_THRESHOLD = CLIP**2
FEWEST = 3  # least number of windows since an onset that counts
DAY_S = 86400.0
_AGREED, _WINDOWS, _SQUARES, _MOVED, _MOVED_TIMES, _INFORMATION, _INFORMATION_TIMES, _INFORMATION_SQUARES = range(8)


@dataclass(frozen=True, slots=True)
class FittedChange:
    """The step or ramp that fits best.

    `size`, `u_size` in the unit of the parameter (per day for a ramp); `onset` is the number of the window with which
    it began, `onset_s` the time of that window; `gain` is the increase of the log-likelihood over no change; `scatter`
    is chi-squared per degree of freedom of the scores about it, at least 1.
    """

    size: float
    u_size: float
    onset: int
    onset_s: float
    gain: float
    scatter: float


class Onsets:
    """The sums for `series` parameters; each window adds to all of them."""

    def __init__(self, series: int) -> None:
        self._count = 0  # windows so far
        self._numbers = np.empty(0, dtype=np.int64)  # (K,) the window each onset began with
        self._starts_s = np.empty(0)
        self._sums = np.empty((8, 0, series))
        self._began = np.zeros(series, dtype=np.int64)  # earlier onsets do not count
        self._pinned = np.full(series, -1, dtype=np.int64)  # onsets that are kept however old, -1 for none

    def update(self, t_s: float, score: Array, information: Array) -> None:
        """Take a window at the time `t_s`, which rises: its scores and information, both (series,).

        A score is NaN, or its information 0, if the window has no information on the parameter.
        """
        seen = np.isfinite(score) & np.isfinite(information) & (information > 0.0)
        s, weight = np.where(seen, score, 0.0), np.sqrt(np.where(seen, information, 0.0))
        self._numbers = np.append(self._numbers, self._count)
        self._starts_s = np.append(self._starts_s, t_s)
        self._sums = np.concatenate([self._sums, np.zeros((8, 1, len(s)))], axis=1)
        self._count += 1
        since_days = ((t_s - self._starts_s) / DAY_S)[:, None]
        self._sums[_AGREED] += weight * np.clip(s, -CLIP, CLIP)
        self._sums[_WINDOWS] += seen
        self._sums[_SQUARES] += s**2
        self._sums[_MOVED] += weight * s
        self._sums[_MOVED_TIMES] += weight * s * since_days
        self._sums[_INFORMATION] += weight**2
        self._sums[_INFORMATION_TIMES] += weight**2 * since_days
        self._sums[_INFORMATION_SQUARES] += (weight * since_days) ** 2
        self._thin_out()

    def _thin_out(self) -> None:
        ages = self._count - self._numbers
        octave = np.maximum(np.frexp(ages / DENSE)[1] - 1, 0)
        pinned = (self._numbers[:, None] == self._pinned).any(axis=1)  # np.isin needs ten times as long
        keep = (ages < SPAN) & ((self._numbers % (1 << octave) == 0) | pinned)
        if not keep.all():
            self._numbers, self._starts_s = self._numbers[keep], self._starts_s[keep]
            self._sums = self._sums[:, keep]

    def restart(self, series: NDArray[np.bool_]) -> None:
        """Forget all sums of the flagged parameters (series,)."""
        self._sums[:, :, series] = 0.0
        self._began[series] = self._count
        self._pinned[series] = -1

    def pin(self, series: int, onset: int) -> None:
        """Keep this onset at any age, because the size since a neighbouring onset would differ by more than its u."""
        self._pinned[series] = onset

    def windows(self) -> NDArray[np.int64]:
        """(series,) number of windows with information since the last restart or the oldest onset."""
        return np.asarray(self._sums[_WINDOWS].max(axis=0, initial=0.0), dtype=np.int64)

    def strongest(self) -> Array:
        """(series,) statistic of the test: the largest log-likelihood ratio of a step, over all onsets; at least 0."""
        return np.asarray(self._statistic(slice(None)).max(axis=0, initial=0.0))

    def _statistic(self, series: slice) -> Array:
        windows = self._sums[_WINDOWS, :, series]
        counts = (windows >= FEWEST) & (self._numbers[:, None] >= self._began[series])
        agreed, information = self._sums[_AGREED, :, series], self._sums[_INFORMATION, :, series]
        return np.where(counts, agreed**2, 0.0) / np.where(counts, 2.0 * information, 1.0)

    def best_step(self, series: int) -> FittedChange:
        """The step that fits best. Call it only if `strongest` is above 0."""
        onset, gain = self._best(series, _MOVED, _INFORMATION)
        sums = self._sums[:, onset, series]
        return self._change(series, onset, gain, sums[_MOVED] / sums[_INFORMATION], 1.0 / sums[_INFORMATION])

    def best_ramp(self, series: int) -> FittedChange:
        """The ramp that fits best; its size is per day. Call it only if `strongest` is above 0."""
        onset, gain = self._best(series, _MOVED_TIMES, _INFORMATION_SQUARES)
        moved, moved_times, i, i_times, i_squares = self._sums[_MOVED:, onset, series]
        # A constant is estimated beside the slope, because the true onset may lie between two that are kept.
        spread = i_squares - i_times**2 / i
        if not spread > 0.0:  # all windows have the same time: parts of one stretch that has missing samples
            return self._change(series, onset, 0.0, 0.0, np.inf)
        return self._change(series, onset, gain, (moved_times - moved * i_times / i) / spread, 1.0 / spread)

    def _best(self, series: int, moved: int, information: int) -> tuple[int, float]:
        statistic = self._statistic(slice(series, series + 1))[:, 0]
        # Only onsets whose clipped statistic is large: one outlying window could otherwise become the onset.
        loud = np.flatnonzero(statistic >= statistic.max() / 2)
        told = 2.0 * self._sums[information, loud, series]
        gains = np.divide(self._sums[moved, loud, series] ** 2, told, out=np.zeros_like(told), where=told > 0.0)
        best = len(loud) - 1 - int(np.argmax(gains[::-1]))  # the youngest of equal ones: no information between them
        return int(loud[best]), float(gains[best])

    def _change(self, series: int, onset: int, gain: float, size: float, variance: float) -> FittedChange:
        squares, windows = self._sums[_SQUARES, onset, series], self._sums[_WINDOWS, onset, series]
        scatter = max(1.0, float((squares - 2.0 * gain) / (windows - 1.0)))
        start_s = float(self._starts_s[onset])
        u_size = float(np.sqrt(scatter * variance))
        return FittedChange(float(size), u_size, int(self._numbers[onset]), start_s, gain, scatter)

    def snapshot(self) -> dict[str, Any]:
        """The complete state, for `load`; bit for bit."""
        return {
            "count": self._count,
            "numbers": self._numbers.copy(),
            "starts_s": self._starts_s.copy(),
            "sums": self._sums.copy(),
            "began": self._began.copy(),
            "pinned": self._pinned.copy(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from the state that `snapshot` returned."""
        self._count = state["count"]
        self._numbers, self._starts_s = state["numbers"].copy(), state["starts_s"].copy()
        self._sums = state["sums"].copy()
        self._began, self._pinned = state["began"].copy(), state["pinned"].copy()
