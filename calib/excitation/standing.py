"""Sequential test whether a sensor keeps its position relative to gravity, on short means of its own output.

A rotation of the sensor changes the mean of its output, because gravity acts all the time; vibration and blows hardly
change it. Means over 0.25 s are smoothed over 4 s by Hann's window, which leaves 2.7 % of a vibration with a period of
2 s, and less of faster ones. When the smoothed mean differs from the mean since the position began, the position has
ended. The time of the end is found with the shortest smoothing under which the stretch before shows no departure:
0.25 s at rest, up to 4 s during vibration. A false alarm costs only a few seconds of data: the position is found again.

Slower motion needs a longer smoothing. If no position begins with 4 s, one may begin with 12 s: that leaves 2.7 % of a
motion with a period of 6 s. It takes 18 s without a change in place of 6 s.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calib.model import Array

MEAN_S = 0.25  # length of one mean
SMOOTHINGS = (1, 2, 4, 8, 16, 48)  # numbers of means
USUAL, SLOW = SMOOTHINGS[-2:]  # the longest smoothing, and the one for slow motion
KEPT = 3 * SLOW  # number of means in memory
# Least change of the mean that counts, m/s2: gravity turned by 0.7 deg. A blow of 8 m/s2 and 20 ms, smoothed, is 0.05.
DEPARTURE_MPS2 = 0.12
# Error of a smoothed mean, relative to the rms of the means: 2.7 % of an amplitude is 3.8 % of its rms.
LEAKAGE = 0.05


class Standing:
    """The present position of the sensor, if there is one; `update` and `interrupt` change the state.

    The means are numbered. A stretch in one position holds the means from number `first` up to, but not including, the
    number that `update` or `interrupt` returns when the stretch has ended.
    """

    def __init__(self) -> None:
        self._means = np.zeros((0, 3))
        self._next = 0
        self._centre = np.zeros(3)
        self._rms = 0.0
        self._longest = USUAL
        self.first: int | None = None  # None: the sensor is being turned, or there are too few means so far

    @property
    def next(self) -> int:
        """Number of the next mean."""
        return self._next

    @property
    def centre(self) -> Array:
        """(3,) the mean output at the beginning of the newest stretch."""
        return self._centre.copy()

    @property
    def smoothing_s(self) -> float:
        """Length of the longest smoothing: motion in the stretch has periods of half of it at most."""
        return self._longest * MEAN_S

    @property
    def oldest(self) -> int:
        """Number of the oldest mean at which a stretch may still begin."""
        return self._next - len(self._means)

    @property
    def cleared(self) -> int:
        """Number before which no end of the stretch will be found any more."""
        return max(self._next - steady(self._longest), self.first or 0)

    def update(self, mean: Array) -> int | None:
        """Take the next mean (3,) in m/s2. Returns the number at which the stretch ended, None if it goes on."""
        self._means = np.vstack([self._means, mean])[-KEPT:]
        self._next += 1
        if self.first is None:
            self._begin(USUAL)
            if self.first is None:
                self._begin(SLOW)
            return None
        newest = self._means[-self._longest :]
        smoothed = _smoothed(newest, self._longest)[0]
        limit = DEPARTURE_MPS2 + LEAKAGE * (self._rms + _rms(newest, smoothed))
        if _length(smoothed - self._centre) <= limit:
            return None
        return self._end(self._departed(limit))

    def interrupt(self) -> int | None:
        """Take note that means are missing here, so that the stretch cannot go on.

        Returns the number at which the stretch ended, None if there was no stretch.
        """
        if self.first is None:
            self._means = self._means[:0]
            return None
        newest = self._means[-steady(self._longest) :]
        n = self._quiet(newest, DEPARTURE_MPS2 + 2.0 * LEAKAGE * self._rms)
        return self._end(self._next - n // 2, keep=False)

    def _begin(self, longest: int) -> None:
        """Begin a stretch if no mean that is smoothed over `longest` has departed during the last half more than that.

        The stretch begins at the earliest mean in memory since which there was no departure.
        """
        if len(self._means) < steady(longest):
            return
        newest = self._means[-steady(longest) :]
        smoothed = _smoothed(newest, longest)
        centre = smoothed.mean(axis=0)
        rms = _rms(newest, centre)
        limit = DEPARTURE_MPS2 + 2.0 * LEAKAGE * rms
        if _length(smoothed - centre).max() > 0.5 * limit:
            return
        self._centre, self._rms, self._longest = centre, rms, longest
        n = self._quiet(newest, limit)
        off = np.flatnonzero(_length(_smoothed(self._means, n) - centre) > limit)
        begin = int(off[-1]) + 1 if len(off) else 0
        # Half of the smoothing may hide a departure of twice the limit, but only if there was a departure before. The
        # smoothing for slow motion hides whole turns at the beginning of the memory.
        hidden = n // 2 if len(off) or (longest == SLOW and self.oldest) else 0
        self.first = self.oldest + min(begin + hidden, len(self._means) - longest)

    def _departed(self, limit: float) -> int:
        """Number of the first mean that may no longer belong to the stretch."""
        own = self._means[max((self.first or 0) - self.oldest, 0) :]
        newest = max(len(own) - self._longest, 0)
        before = own[max(newest - steady(self._longest), 0) : newest]
        n = self._quiet(before, limit)
        from_ = max(len(own) - self._longest - n + 1, 0)
        off = np.flatnonzero(_length(_smoothed(own[from_:], n) - self._centre) > limit)
        last = from_ + n - 1 + int(off[0]) if len(off) else len(own) - 1
        return self._next - len(own) + last - n // 2

    def _quiet(self, means: Array, limit: float) -> int:
        """The shortest smoothing (number of means) under which none of these means departs by more than `limit`."""
        for n in SMOOTHINGS:
            if n >= min(self._longest, len(means) + 1):
                break
            if _length(_smoothed(means, n) - self._centre).max() <= limit:
                return n
        return self._longest

    def _end(self, at: int, *, keep: bool = True) -> int:
        at = min(max(at, self.first or 0), self._next)
        self._means = self._means[len(self._means) - (self._next - at) :] if keep else self._means[:0]
        self.first = None
        return at

    def snapshot(self) -> dict[str, Any]:
        """The complete state, for `load`; bit for bit."""
        return {
            "means": self._means.copy(),
            "next": self._next,
            "centre": self._centre.copy(),
            "rms": self._rms,
            "longest": self._longest,
            "first": self.first,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from the state that `snapshot` returned."""
        self._means, self._centre = np.array(state["means"]), np.array(state["centre"])
        self._next, self._rms, self.first = state["next"], state["rms"], state["first"]
        self._longest = state["longest"]


def steady(longest: int) -> int:
    """Number of means without a change after which a position begins, with this smoothing: 6 s for the usual one."""
    return longest + longest // 2


def hann(n: int) -> Array:
    """(n,) weights of Hann's window, with the sum 1; no weight is zero."""
    weights = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2
    return np.asarray(weights / weights.sum())


def _smoothed(means: Array, n: int) -> Array:
    """(len - n + 1, 3) means smoothed over n by Hann's window, in order of time."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(means, n, axis=0) @ hann(n))


def _length(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.sum(np.square(vectors), axis=-1)))


def _rms(means: Array, centre: Array) -> float:
    return float(np.sqrt(np.mean(np.sum((means - centre) ** 2, axis=1))))
