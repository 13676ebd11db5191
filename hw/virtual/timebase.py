"""Times at which a virtual device takes its samples, and at which a gateway reads them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.sensor import GOLDEN
from hw.virtual.noise import BLOCK, NoiseStream, generator

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Clock:
    """A device's clock: sample k is taken at offset_s + k T + (wander T_w / 2 pi) sin(2 pi k T / T_w).

    T = 1 / (nominal_rate_hz * (1 + rate_error)), T_w = wander_period_s. `wander` is the largest relative change of the
    period in a thermal cycle (250e-6: +-250 ppm).
    """

    nominal_rate_hz: float = 1000.0
    rate_error: float = 0.0
    offset_s: float = 0.0
    wander: float = 0.0
    wander_period_s: float = 1800.0

    @property
    def rate_hz(self) -> float:
        """The true mean rate."""
        return self.nominal_rate_hz * (1 + self.rate_error)

    def times(self, first: int, n: int) -> Array:
        """True times of samples first .. first + n - 1 on the bench's clock, in s."""
        return self._time(np.arange(first, first + n))

    def due(self, t_s: Array | float) -> IntArray:
        """Number of samples that exist at `t_s`: those taken at or before `t_s`."""
        t = np.asarray(t_s, dtype=float)
        nominal = t - self.offset_s
        # Each iteration improves the result by the factor `wander`, 1e-3 at most
        for _ in range(3 if self.wander else 0):
            nominal = t - self.offset_s - self._wander_s(nominal)
        count = np.floor(nominal * self.rate_hz).astype(np.int64) + 1
        # rounding in the inverse must not contradict times()
        count -= self._time(count - 1) > t
        count += self._time(count) <= t
        return np.maximum(count, 0)

    def _time(self, index: IntArray) -> Array:
        nominal = index / self.rate_hz
        return self.offset_s + nominal + self._wander_s(nominal)

    def _wander_s(self, nominal_s: Array) -> Array | float:
        if not self.wander:
            return 0.0
        turn = 2 * np.pi / self.wander_period_s
        return self.wander / turn * np.sin(turn * nominal_s)


@dataclass(frozen=True, slots=True)
class Bursts:
    """Times at which a gateway reads a device: every `poll_s`, plus a delay, rarely plus a stall.

    The delay is `least_late_s` + an exponential of mean `mean_late_s`. `apart_s`: range over which the reads are spread
    by the golden ratio, as the drivers in hw spread them over a sample period so that reads and samples do not beat; 0
    for a gateway that does not spread its reads.
    """

    poll_s: float = 0.016
    least_late_s: float = 80e-6
    mean_late_s: float = 200e-6
    stall_probability: float = 0.01
    longest_stall_s: float = 0.015
    apart_s: float = 0.0
    # Stamps count back from a burst's arrival at the nominal rate; otherwise all samples of a burst have one stamp
    spread: bool = False

    def arrivals(self, seed: int, stream: NoiseStream, until_s: float) -> Array:
        """Arrival times (B,) of the reads up to `until_s`; they never decrease."""
        reads = int(until_s / self.poll_s)
        late = np.concatenate([self._lateness(seed, stream, block) for block in range(reads // BLOCK + 1)])
        number = np.arange(1, reads + 1)
        times = self.poll_s * number + self.apart_s * (number * GOLDEN % 1.0) + late[:reads]
        times = np.maximum.accumulate(times)
        return np.asarray(times[times <= until_s])

    def stamps(self, clock: Clock, arrivals: Array) -> Array:
        """The stamps (N,) that a gateway writes for the samples of `arrivals`."""
        due = clock.due(arrivals)
        count = np.diff(due, prepend=0)
        stamps = np.repeat(arrivals, count)
        if self.spread:
            stamps -= (np.repeat(due, count) - 1 - np.arange(due[-1] if len(due) else 0)) / clock.nominal_rate_hz
        return stamps

    def _lateness(self, seed: int, stream: NoiseStream, block: int) -> Array:
        random = generator(seed, stream, block)
        late = self.least_late_s + random.exponential(self.mean_late_s, BLOCK)
        stalled = random.random(BLOCK) < self.stall_probability
        return np.asarray(late + stalled * random.uniform(0.3, 1.0, BLOCK) * self.longest_stall_s)


class BenchTime:
    """Converts seconds of the machine's clock to seconds of the bench's clock; -1 before `begin` (no samples)."""

    def __init__(self) -> None:
        self._zero_s: float | None = None

    @property
    def begun(self) -> bool:
        """Whether time runs."""
        return self._zero_s is not None

    def begin(self, t_s: float) -> None:
        """`t_s` of the machine's clock is time 0 of the bench."""
        self._zero_s = t_s

    def __call__(self, t_s: float) -> float:
        return -1.0 if self._zero_s is None else t_s - self._zero_s

    def gated(self, samples_due: Callable[[float], int]) -> Callable[[float], int]:
        """`samples_due` as a function of the machine's time instead of the bench's."""
        return lambda t_s: samples_due(self(t_s))
