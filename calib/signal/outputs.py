"""Whether the outputs of a device still follow what they measure: looked for in the samples as they were read.

An output that does not change may be dead, or quiet: at rest a sound sensor whose noise is below its resolution shows
one value for hours, or two in turn. A count of equal values alone cannot tell these apart (PX4-ECL, pull request 219:
false alarms of sensors at rest). So a held output is called stuck only where a sound one could not have held:

- its own noise was always larger than its resolution, and another output of the device still shows such noise now;
- it never changed since the device was opened, and all other outputs have noise of twice the resolution or more;
- a reference beside it moved along it by several steps of the resolution meanwhile.

Noise is the median of the spectrum: motion in less than half of it, such as that of a machine beside the sensor, does
not change it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.signal.band import hanning
from calib.signal.order_statistics import median

CHUNK, CHUNK_S = 64, 0.5  # samples of which the noise is found together: as many, or as many as in this time
MINUTE_S = 60.0  # of chunks, whose median is compared with that of other minutes
FINE = 1.0  # noise over resolution: two neighbours are then equal in 28 of 100 cases
SURE, SURE_S = 100, 1.0  # equal samples of such an output: by chance once in 1e55
ALL_S = 30.0  # where no output of the device changes: what moved it may have stopped
NEVER, NEVER_S = 1000, 60.0  # samples of an output that never changed
MOVED, MOVED_S, FEWEST = 3.0, 3.0, 20  # rms of the motion over the resolution, for so long, and so many samples
SLOW_S = 0.1  # means of so long a time show the motion that any sensor passes
STICK, STICK_S = 16, 0.1  # equal samples of a fine output that are no chance: once in 1e8
ALONE = 64.0  # times the usual distance of a sample from the middle of its neighbours: it stands alone
BETWEEN = 0.25  # of that distance, at most, its neighbours differ
NEAR_POWER = 1.0 / 32.0  # of a power of two: 9 of 100 distances of any size are so near to one
ROUNDED = 1.0 + 1e-6  # times the resolution: a device may give decimals
LEAST_BURST, LEAST_CHANGES = 8, 8  # of a burst that is compared with the one before it


@dataclass(frozen=True, slots=True)
class StuckOutput:
    """An output that is held at `low`, or toggles between `low` and `high`, since sample number `first`."""

    axis: int
    first: int
    low: float
    high: float


class Outputs:
    """The newest samples of one device: how long each output is held, its resolution and its noise.

    `sticks` (A,): how often each output was held for a short time and went on. `repeats`: how many bursts were the same
    as the burst before them. `alone`: how many single samples stood far from their neighbours, and `flipped`: how many
    of these by a power of two of the resolution, as where one bit is wrong. All count from the opening.
    """

    def __init__(self, axes: int) -> None:
        self.step = np.inf  # the smallest change of any output: the resolution
        self.sticks: NDArray[np.int64] = np.zeros(axes, dtype=np.int64)
        self.repeats = self.alone = self.flipped = 0
        # In the last update: the outputs that held one value, or all of a burst that was read twice; and those with
        # samples that stand alone as a wrong bit makes them.
        self.stuck_or_repeated: NDArray[np.bool_] = np.zeros(axes, dtype=np.bool_)
        self.flips: NDArray[np.bool_] = np.zeros(axes, dtype=np.bool_)
        # Samples: so far, before they were counted anew, and the number of the next one.
        self._taken = self._begun = self._next = 0
        self._rate_hz = 1.0
        self._last = np.full(axes, np.nan)
        # Since which of the samples that were taken, and since which number: an output has one value, and it is between
        # two values, `_ends`, that are one step apart.
        self._same: NDArray[np.int64] = np.zeros((2, axes), dtype=np.int64)
        self._near: NDArray[np.int64] = np.zeros((2, axes), dtype=np.int64)
        self._ends = np.zeros((2, axes))
        self._chunk, self._burst = np.zeros((0, axes)), np.zeros((0, axes))
        self._minute = np.zeros((0, axes))  # the noise of chunks, NaN where the output was held
        self._noise, self._quietest = np.full(axes, np.nan), np.full(axes, np.nan)
        self._stuck: NDArray[np.bool_] = np.zeros(axes, dtype=np.bool_)  # as `held` found it last
        self._part, self._slow = np.zeros((0, axes)), np.zeros((0, axes))  # means over SLOW_S

    @property
    def axes(self) -> int:
        """A."""
        return len(self._last)

    @np.errstate(all="ignore")  # numbers that nothing can be computed from are told elsewhere
    def update(self, first: int, x: Array, rate_hz: float, bursts: NDArray[np.int32], *, anew: bool) -> None:
        """Take the samples x (n, A) from number `first` on, read in bursts that end behind `bursts` (B,).

        `anew`: nobody can count them on from those before.
        """
        if not len(x):
            return
        self.stuck_or_repeated, self.flips = np.zeros_like(self.flips), np.zeros_like(self.flips)
        if anew or not self._taken:
            self._begun, self._last, self._ends = self._taken, x[0], np.stack([x[0], x[0]])
            self._same[0], self._same[1] = self._near[0], self._near[1] = self._taken, first
        if anew or first != self._next:
            self._chunk, self._part, self._slow, self._burst = x[:0], x[:0], x[:0], x[:0]
        self._rate_hz = rate_hz
        self._follow(first, x)
        self._taken, self._next = self._taken + len(x), first + len(x)
        self._look_for_repeats(x, bursts)
        self._look_for_flips(x)
        self._find_noise(x)
        width = max(1, round(SLOW_S * rate_hz))
        part = np.vstack([self._part, x])
        means = part[: len(part) // width * width].reshape(-1, width, x.shape[1]).mean(axis=1)
        self._part = part[len(means) * width :]
        self._slow = np.vstack([self._slow, means])[-max(2, round(MOVED_S * rate_hz / width)) :]

    @property
    @np.errstate(all="ignore")
    def motion(self) -> Array:
        """(A, A) covariance of slow means over the last MOVED_S, less than its noise there where that is much of it."""
        if len(self._slow) < FEWEST:
            return np.zeros((len(self._last), len(self._last)))
        width = max(1, round(SLOW_S * self._rate_hz))
        noise = np.nan_to_num(self._noise) ** 2 / width
        covariance = np.atleast_2d(np.cov(self._slow.T))
        return np.asarray(covariance - 25.0 * np.diag(noise))

    def held(self, expected: Array) -> list[StuckOutput]:
        """The outputs that a sound device could not have held. `expected` (A,): rms of the motion along each output in
        the last MOVED_S as another device tells it, in output unit; 0 where none does."""
        length, fine = self._taken - self._same[0], self._quietest >= FINE * self.step
        held_s = length / self._rate_hz
        noisy = (self._noise >= FINE * self.step) & (length < CHUNK)
        long = (length >= SURE) & (held_s >= SURE_S)
        near = self._taken - self._near[0]
        found, self._stuck = [], np.zeros(len(length), dtype=np.bool_)
        for k in np.flatnonzero(long | ((near >= FEWEST) & (near / self._rate_hz >= MOVED_S))).tolist():
            others = np.arange(len(length)) != k
            own = long[k] and fine[k] and (noisy[others].any() or (long.all() and held_s[k] >= ALL_S))
            never = self._same[0, k] == self._begun and length[k] >= NEVER and held_s[k] >= NEVER_S
            never &= others.any() and bool((self._quietest[others] >= 2.0 * FINE * self.step).all())
            if own or never:
                found.append(StuckOutput(k, int(self._same[1, k]), float(self._last[k]), float(self._last[k])))
            elif np.isfinite(self.step) and near[k] / self._rate_hz >= MOVED_S and expected[k] >= MOVED * self.step:
                found.append(StuckOutput(k, int(self._near[1, k]), *self._ends[:, k].tolist()))
        self._stuck[[held.axis for held in found]] = True
        return found

    def goes_on(self, held: StuckOutput) -> bool:
        """Whether an output has not changed since it was found to be held."""
        since = self._same if held.low == held.high else self._near
        return bool(since[1, held.axis] <= held.first)

    def _follow(self, first: int, x: Array) -> None:
        """How long each output has one value, or two values one step apart."""
        changes = np.abs(np.diff(np.vstack([self._last, x]), axis=0))
        moved = changes > 0.0
        self.step = min(self.step, float(np.min(changes, where=moved, initial=np.inf)))
        fine = self._quietest >= FINE * self.step
        least = max(STICK, round(STICK_S * self._rate_hz))
        ends = np.stack([np.minimum(self._ends[0], x.min(axis=0)), np.maximum(self._ends[1], x.max(axis=0))])
        one_step = ROUNDED * self.step
        for k in range(x.shape[1]):
            if len(at := np.flatnonzero(moved[:, k])):
                runs = np.diff(np.concatenate([[self._same[0, k]], self._taken + at]))
                sticks = np.count_nonzero(runs >= least) if fine[k] else 0
                self.sticks[k] += sticks
                self.stuck_or_repeated[k] = sticks > 0
                self._same[:, k] = self._taken + at[-1], first + at[-1]
            self.stuck_or_repeated[k] |= fine[k] and self._taken + len(x) - self._same[0, k] >= least
            if ends[1, k] - ends[0, k] <= one_step:
                self._ends[:, k] = ends[:, k]
            else:
                back = x[::-1, k]
                spread = np.maximum.accumulate(back) - np.minimum.accumulate(back)
                count = max(int(np.searchsorted(spread, one_step, "right")), 1)
                self._near[:, k] = self._taken + len(x) - count, first + len(x) - count
                self._ends[:, k] = back[:count].min(), back[:count].max()
        self._last = x[-1]

    def _look_for_repeats(self, x: Array, bursts: NDArray[np.int32]) -> None:
        """A burst that is the same as the one before it, though its samples differ from each other."""
        ends = bursts.tolist() if len(bursts) and len(x) >= LEAST_BURST * len(bursts) else [len(x)]
        for begin, end in zip([0, *ends[:-1]], ends, strict=True):
            burst, before = x[begin:end], self._burst
            self._burst = burst
            if burst.shape != before.shape or len(burst) < LEAST_BURST or not np.array_equal(burst, before):
                continue
            changes = np.count_nonzero((np.diff(burst, axis=0) != 0.0).any(axis=1))
            both = np.vstack([before, burst])
            periodic = any(np.array_equal(both[lag:], both[:-lag]) for lag in range(1, len(burst) // 2 + 1))
            if changes >= LEAST_CHANGES and not periodic:
                self.repeats += 1
                self.stuck_or_repeated[:] = True

    def _look_for_flips(self, x: Array) -> None:
        """Samples within the block that stand alone."""
        away, between = np.abs(x[1:-1] - 0.5 * (x[2:] + x[:-2])), np.abs(x[2:] - x[:-2])
        if not len(away):
            return
        usual = np.maximum(median(np.ascontiguousarray(away.T)), self.step)
        alone, size = (away > ALONE * usual) & (between < BETWEEN * away), away / self.step
        power = np.exp2(np.round(np.log2(size)))
        flipped = alone & (np.abs(size - power) < NEAR_POWER * power)
        self.alone += int(np.count_nonzero(alone))
        self.flipped += int(np.count_nonzero(flipped))
        self.flips = np.any(flipped, axis=0)

    def _find_noise(self, x: Array) -> None:
        size = max(CHUNK, round(CHUNK_S * self._rate_hz))
        self._chunk = np.vstack([self._chunk, x])
        count = len(self._chunk) // size
        if not count:
            return
        chunks, self._chunk = self._chunk[: count * size].reshape(count, size, -1), self._chunk[count * size :]
        window = hanning(size)
        lines = np.fft.rfft((chunks - chunks.mean(axis=1, keepdims=True)) * window[:, None], axis=1)[:, 1:-1]
        power = median(np.ascontiguousarray((lines.real**2 + lines.imag**2).swapaxes(1, 2)))
        noise = np.sqrt(power / (np.log(2.0) * np.sum(window**2)))  # a line of white noise is exponential
        noise[np.ptp(chunks, axis=1) == 0.0] = np.nan
        self._noise, self._minute = noise[-1], np.vstack([self._minute, noise])
        if len(self._minute) >= MINUTE_S * self._rate_hz / size:
            for k, own in enumerate(self._minute.T):
                shown = own[np.isfinite(own)]
                if len(shown) or not self._stuck[k]:
                    self._quietest[k] = np.fmin(self._quietest[k], float(median(shown)) if len(shown) else 0.0)
            self._minute = self._minute[:0]

    def snapshot(self) -> dict[str, Any]:
        """State for `restore`, bit-exact."""
        return {name: np.copy(value) if isinstance(value, np.ndarray) else value for name, value in vars(self).items()}

    @classmethod
    def restore(cls, state: Mapping[str, Any]) -> Outputs:
        """The object whose `snapshot` this is."""
        found = cls(len(state["_last"]))
        for name, value in state.items():
            setattr(found, name, np.array(value) if isinstance(value, np.ndarray) else value)
        return found
