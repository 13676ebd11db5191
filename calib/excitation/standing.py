"""Whether a sensor keeps its place against gravity: a sequential test on short means of its own output.

Gravity is felt all the time, so a sensor that is turned shows it in the mean of what it reads, while vibration and
blows have none. Means of 0.25 s are smoothed over 4 s by Hann's window, which leaves 2.7 % of a vibration of 2 s period
and less of quicker ones; where that departs from what was read since the place was taken, the place was left. When, is
read from the shortest smoothing under which the stretch before was quiet: 0.25 s at rest, up to 4 s while it shakes.
A false alarm costs a few seconds of data: the place is found again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calib.model import Array

MEAN_S = 0.25  # one mean, number by number
SMOOTHINGS = (1, 2, 4, 8, 16)  # means
LONGEST = SMOOTHINGS[-1]
STEADY = LONGEST + LONGEST // 2  # means without a change that make a place: 6 s
KEPT = 2 * STEADY  # means
# A departure of the mean that counts, m/s2: 0.7 deg of gravity; a blow of 8 m/s2 and 20 ms, smoothed, makes 0.05.
DEPARTURE_MPS2 = 0.12
# Of the means' own rms that a smoothed mean may be off by: 2.7 % of an amplitude is 3.8 % of its rms.
LEAKAGE = 0.05


class Standing:
    """The place where the sensor stands now, if it does. `update` and `interrupt` change it.

    Numbers count means; a stretch is from `first` on up to, and without, the number that `update` gives when it ended.
    """

    def __init__(self) -> None:
        self._means = np.zeros((0, 3))
        self._next = 0
        self._centre = np.zeros(3)
        self._rms = 0.0
        self.first: int | None = None  # None: it moves, or nobody can tell yet

    @property
    def next(self) -> int:
        """Number of the mean that is awaited."""
        return self._next

    @property
    def oldest(self) -> int:
        """Number from which on a place may still begin."""
        return self._next - len(self._means)

    @property
    def cleared(self) -> int:
        """Number up to which, and without, no change will be found any more."""
        return max(self._next - STEADY, self.first or 0)

    def update(self, mean: Array) -> int | None:
        """Take the next mean (3,), m/s2; where it shows that the stretch ended, the number at which."""
        self._means = np.vstack([self._means, mean])[-KEPT:]
        self._next += 1
        if self.first is None:
            self._begin()
            return None
        smoothed = _smoothed(self._means[-LONGEST:], LONGEST)[0]
        limit = DEPARTURE_MPS2 + LEAKAGE * (self._rms + _rms(self._means[-LONGEST:], smoothed))
        if _length(smoothed - self._centre) <= limit:
            return None
        return self._end(self._departed(limit))

    def interrupt(self) -> int | None:
        """Means are missing here: nobody knows what happened. The number at which a stretch ended, if there was one."""
        if self.first is None:
            self._means = self._means[:0]
            return None
        n = self._quiet(self._means[-STEADY:], DEPARTURE_MPS2 + 2.0 * LEAKAGE * self._rms)
        return self._end(self._next - n // 2, keep=False)

    def _begin(self) -> None:
        """A place is taken where nothing departed for as long as STEADY; it began where that holds back to."""
        if len(self._means) < STEADY:
            return
        newest = self._means[-STEADY:]
        smoothed = _smoothed(newest, LONGEST)
        centre = smoothed.mean(axis=0)
        rms = _rms(newest, centre)
        limit = DEPARTURE_MPS2 + 2.0 * LEAKAGE * rms
        if _length(smoothed - centre).max() > 0.5 * limit:
            return
        self._centre, self._rms = centre, rms
        n = self._quiet(newest, limit)
        off = _length(_smoothed(self._means, n) - centre) > limit
        begin = int(np.flatnonzero(off)[-1]) + 1 if off.any() else 0
        # Half of the smoothing may hide a departure of twice the limit; where nothing was before, nothing is hidden.
        self.first = self.oldest + min(begin + (n // 2 if off.any() else 0), len(self._means) - LONGEST)

    def _departed(self, limit: float) -> int:
        """Number of the first mean that may not belong to the stretch."""
        own = self._means[max((self.first or 0) - self.oldest, 0) :]
        before = own[max(len(own) - LONGEST - STEADY, 0) : max(len(own) - LONGEST, 0)]
        n = self._quiet(before, limit)
        from_ = max(len(own) - LONGEST - n + 1, 0)
        off = np.flatnonzero(_length(_smoothed(own[from_:], n) - self._centre) > limit)
        last = from_ + n - 1 + int(off[0]) if len(off) else len(own) - 1
        return self._next - len(own) + last - n // 2

    def _quiet(self, means: Array, limit: float) -> int:
        """The shortest smoothing under which these means never depart."""
        for n in SMOOTHINGS:
            if len(means) >= n and _length(_smoothed(means, n) - self._centre).max() <= limit:
                return n
        return LONGEST

    def _end(self, at: int, *, keep: bool = True) -> int:
        at = min(max(at, self.first or 0), self._next)
        self._means = self._means[len(self._means) - (self._next - at) :] if keep else self._means[:0]
        self.first = None
        return at

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            "means": self._means.copy(),
            "next": self._next,
            "centre": self._centre.copy(),
            "rms": self._rms,
            "first": self.first,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._means, self._centre = np.array(state["means"]), np.array(state["centre"])
        self._next, self._rms, self.first = state["next"], state["rms"], state["first"]


def hann(n: int) -> Array:
    """(n,) weights, sum 1; none is zero."""
    weights = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2
    return np.asarray(weights / weights.sum())


def _smoothed(means: Array, n: int) -> Array:
    """(len - n + 1, 3), in order of time."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(means, n, axis=0) @ hann(n))


def _length(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.sum(np.square(vectors), axis=-1)))


def _rms(means: Array, centre: Array) -> float:
    return float(np.sqrt(np.mean(np.sum((means - centre) ** 2, axis=1))))
