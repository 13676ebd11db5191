"""What windows say of a change since each of many possible onsets (GLR, Willsky and Jones 1976).

A window's score s of a parameter is standard normal while nothing changes; a change d moves its mean by d sqrt(I), I
being the window's information. For a change that began with window j the likelihood ratio against no change is
(sum sqrt(I) s)^2 / (2 sum I) over the windows since j, and (sum sqrt(I) s) / (sum I) is its size; a ramp that began
there has sqrt(I) (t - t_j) in the place of sqrt(I). Sums are kept since each onset. Onsets thin out with their age
(eight an octave), so that cost and memory are bounded, and nothing is forgotten within `SPAN` windows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.model import Array

DENSE = 8  # windows: younger onsets are all kept; a missed onset costs at most 1/16 of the statistic
SPAN = 16384  # windows: almost two years of one an hour
# Scores beyond are cut for the test, not for sizes. Two windows reach CLIP^2 at most (Cauchy-Schwarz), whatever they
# hold: a threshold from there on takes at least three that agree. One honest score in 2000 is beyond.
CLIP = 3.5
LEAST_THRESHOLD = CLIP**2
FEWEST = 3  # windows since an onset, before it counts
DAY_S = 86400.0
_AGREED, _WINDOWS, _SQUARES, _MOVED, _MOVED_TIMES, _INFORMATION, _INFORMATION_TIMES, _INFORMATION_SQUARES = range(8)


@dataclass(frozen=True, slots=True)
class Change:
    """The change that fits best: `size` (a day, for a ramp) with its standard uncertainty, the window it began with and
    its time, and how much the log-likelihood gains by it over no change. `scatter`: chi-squared per degree of freedom
    about it, at least 1.
    """

    size: float
    u_size: float
    onset: int
    onset_s: float
    gain: float
    scatter: float


class Onsets:
    """The sums of `series` parameters, all fed by the same windows."""

    def __init__(self, series: int) -> None:
        self._count = 0  # windows so far
        self._numbers = np.empty(0, dtype=np.int64)  # (K,) the window each onset began with
        self._starts_s = np.empty(0)
        self._sums = np.empty((8, 0, series))
        self._began = np.zeros(series, dtype=np.int64)  # onsets before do not count
        self._pinned = np.full(series, -1, dtype=np.int64)  # onsets that stay, -1 for none

    def update(self, t_s: float, score: Array, information: Array) -> None:
        """A window: scores and information (series,), NaN or 0 where it tells nothing. Times grow."""
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
        keep = (ages < SPAN) & ((self._numbers % (1 << octave) == 0) | np.isin(self._numbers, self._pinned))
        if not keep.all():
            self._numbers, self._starts_s = self._numbers[keep], self._starts_s[keep]
            self._sums = self._sums[:, keep]

    def restart(self, series: NDArray[np.bool_]) -> None:
        """Forget what these (series,) flags name."""
        self._sums[:, :, series] = 0.0
        self._began[series] = self._count
        self._pinned[series] = -1

    def pin(self, series: int, onset: int) -> None:
        """Keep this onset however old it grows: a size from a neighbour would be off by more than its uncertainty."""
        self._pinned[series] = onset

    def windows(self) -> NDArray[np.int64]:
        """(series,) windows that told something since the last restart, as far back as is kept."""
        return np.asarray(self._sums[_WINDOWS].max(axis=0, initial=0.0), dtype=np.int64)

    def strongest(self) -> Array:
        """(series,) the test's statistic: the largest likelihood ratio of a step, over all onsets; 0 without any."""
        return np.asarray(self._statistic(slice(None)).max(axis=0, initial=0.0))

    def _statistic(self, series: slice) -> Array:
        windows = self._sums[_WINDOWS, :, series]
        counts = (windows >= FEWEST) & (self._numbers[:, None] >= self._began[series])
        agreed, information = self._sums[_AGREED, :, series], self._sums[_INFORMATION, :, series]
        return np.where(counts, agreed**2, 0.0) / np.where(counts, 2.0 * information, 1.0)

    def best_step(self, series: int) -> Change:
        """The step that fits best. Call it only where `strongest` is above 0."""
        onset, gain = self._best(series, _MOVED, _INFORMATION)
        sums = self._sums[:, onset, series]
        return self._change(series, onset, gain, sums[_MOVED] / sums[_INFORMATION], 1.0 / sums[_INFORMATION])

    def best_ramp(self, series: int) -> Change:
        """The ramp that fits best, its size a day. Call it only where `strongest` is above 0."""
        onset, gain = self._best(series, _MOVED_TIMES, _INFORMATION_SQUARES)
        moved, moved_times, i, i_times, i_squares = self._sums[_MOVED:, onset, series]
        # A level beside the slope: the onset is known only as one of those kept.
        spread = i_squares - i_times**2 / i
        if not spread > 0.0:  # all windows at one time: pieces of a stretch with samples missing in it
            return self._change(series, onset, 0.0, 0.0, np.inf)
        return self._change(series, onset, gain, (moved_times - moved * i_times / i) / spread, 1.0 / spread)

    def _best(self, series: int, moved: int, information: int) -> tuple[int, float]:
        statistic = self._statistic(slice(series, series + 1))[:, 0]
        # Only where the test itself speaks: a wild window before the onset would else draw the onset to it.
        loud = np.flatnonzero(statistic >= statistic.max() / 2)
        told = 2.0 * self._sums[information, loud, series]
        gains = np.divide(self._sums[moved, loud, series] ** 2, told, out=np.zeros_like(told), where=told > 0.0)
        best = len(loud) - 1 - int(np.argmax(gains[::-1]))  # of equals the youngest: windows between told nothing
        return int(loud[best]), float(gains[best])

    def _change(self, series: int, onset: int, gain: float, size: float, variance: float) -> Change:
        squares, windows = self._sums[_SQUARES, onset, series], self._sums[_WINDOWS, onset, series]
        scatter = max(1.0, float((squares - 2.0 * gain) / (windows - 1.0)))
        start_s = float(self._starts_s[onset])
        u_size = float(np.sqrt(scatter * variance))
        return Change(float(size), u_size, int(self._numbers[onset]), start_s, gain, scatter)

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            "count": self._count,
            "numbers": self._numbers.copy(),
            "starts_s": self._starts_s.copy(),
            "sums": self._sums.copy(),
            "began": self._began.copy(),
            "pinned": self._pinned.copy(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._count = state["count"]
        self._numbers, self._starts_s = state["numbers"].copy(), state["starts_s"].copy()
        self._sums = state["sums"].copy()
        self._began, self._pinned = state["began"].copy(), state["pinned"].copy()
