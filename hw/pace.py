"""The count of samples against the clock: tells samples that somebody else took out of a FIFO."""

from __future__ import annotations

from collections import deque

import numpy as np

POLLS = 400  # that are compared: 8 s at 20 ms, in which a device's clock drifts by less than a tenth of a sample
LEAST_POLLS = 8  # before anything is said
RATE_WITHIN = 0.3  # relative; oscillators of MEMS are off by a few per cent, some by more
SLOPES, STEPS = 33, 6  # rates that are tried in each step; a step makes the range of rates 16 times smaller
MISSING = 0.5  # samples; one sample that is missing moves a count by 1
# Samples. A count that lags the clock by less proves that none is missing, for then it would lag by 1 or more.
SURE = 0.5


class Pace:
    """Holds the counts of some seconds against one constant rate.

    A device that samples at a constant rate f has made floor(f (t - t0)) samples at time t. Where no f and t0 fit all
    counts, samples were taken out of the FIFO or lost between them. `together`: the samples come so many at a time, so
    that a count may be behind by as many.
    """

    def __init__(self, rate_hz: float, together: int = 1) -> None:
        self._rate_hz = rate_hz
        self._together = together
        self._polls: deque[tuple[int, int, int]] = deque(maxlen=POLLS)  # earliest and latest time in ns, samples so far
        self._count = 0

    def restart(self) -> None:
        """The samples from now on do not follow those before."""
        self._polls.clear()
        self._count = 0

    def add(self, t_ns: int, half_ns: int, samples: int) -> None:
        """A poll within `half_ns` around `t_ns` found so many new samples."""
        self._count += samples
        self._polls.append((t_ns - half_ns, t_ns + half_ns, self._count))

    @property
    def missing(self) -> bool:
        """Whether no constant rate fits all counts, so that samples are missing."""
        return self._fit()[0] > self._together + MISSING

    @property
    def proved(self) -> bool:
        """Whether the last poll proves that no sample is missing; True while there are too few polls to tell."""
        return self._fit()[1] < SURE

    def _fit(self) -> tuple[float, float]:
        """Least possible range of the counts' lags behind the clock, and the last lag at that rate; in samples."""
        if len(self._polls) < LEAST_POLLS:
            return 0.0, 0.0
        earliest, latest, count = np.array(self._polls, np.int64).T
        early, late = ((t - earliest[0]) * 1e-9 * self._rate_hz for t in (earliest, latest))
        n = (count - count[0]).astype(np.float64)
        low, high = 1.0 - RATE_WITHIN, 1.0 + RATE_WITHIN
        for _ in range(STEPS):
            slopes = np.linspace(low, high, SLOPES)[:, None]
            ranges = (n - slopes * late).max(axis=1) + (slopes * early - n).max(axis=1)  # convex in the slope
            best = int(ranges.argmin())
            low, high = slopes[max(best - 1, 0), 0], slopes[min(best + 1, SLOPES - 1), 0]
        slope = slopes[best, 0]
        return float(ranges[best]), float(slope * early[-1] - n[-1] + (n - slope * late).max())
