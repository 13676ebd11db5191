"""Clock model of a device: the times of its samples, estimated from the times at which its bursts arrived.

A burst arrives after its newest sample was taken, never before. The delay is therefore one-sided, whether it comes from
the phase of a poll, from the transport or from a stall of the program. So the model follows the *earliest* arrivals: it
is a parabola below the points of the last minute (arrival time over sample number). The two earliest arrivals of each
group of bursts give the group's point of that lower edge. The constant part of the delay (for example of a bus
transfer) cannot be seen in the arrivals; it is part of the lag that the adjustment estimates.

For seconds a busy bus may pass everything on late. Groups that are late together are left out as long as a quarter of
the others is on time. It cannot be told whether such a delay that lasts until now will end: if it stays, samples were
lost that nobody counted, or the delay is another one from now on, and the lag changes when the last minute has it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.model import Array
from calib.signal.order_statistics import median

IntArray = NDArray[np.int64]
# A typical driver sends 3000 bursts in a minute. If the temperature changes the rate by 250 ppm in 30 min, a parabola
# follows the clock within a minute to 1 us.
HORIZON_S = 60.0
MOST_NEW = 64  # blocks whose bursts wait until somebody asks for the clock
MAX_BURSTS = 8192  # limits memory and time for a device that sends each sample as a burst
# Bursts in a group. The earliest two of a small group are later on average; large groups are too few for a fit.
GROUPS, SMALLEST_GROUP, LARGEST_GROUP = 16, 8, 64
CURVED_FROM_S = 20.0  # over a shorter time a straight line is more accurate: the curvature is too uncertain
FEWEST_FOR_RATE = 20  # bursts; with fewer, the nominal rate is more accurate than an estimate

# A group is late by more than LATE_S, and by more than LATE_SD of the scatter of groups, than the earliest quarter. A
# clock that warms up departs from a straight line by 0.06 ms within the minute.
LATE_S, LATE_SD, ON_TIME = 0.002, 12.0, 0.25
FEWEST_ON_TIME = 4  # groups: a parabola has three unknowns

Edge = Literal["early", "mean"]


@dataclass(frozen=True, slots=True, eq=False)
class ClockFit:
    """Time of each sample of a device over its number: cubic pieces between K knots, straight lines beyond the ends.

    `knot_index`, `knot_time_s`, `knot_period_s` (K,): sample number, time (s) and sample period (s) at the knots.
    `index` is the newest sample; `rate_hz` is the rate and `offset_s` the time at that sample, `u_rate_hz`
    and `u_offset_s` their standard uncertainties, without the constant part of the delay. `gaps` are the sample numbers
    before which samples are missing. `late` (k, 2): first and last sample of bursts that arrived so late, for seconds,
    that the clock does not follow from them.
    """

    knot_index: Array
    knot_time_s: Array
    knot_period_s: Array
    index: int
    rate_hz: float
    u_rate_hz: float
    offset_s: float
    u_offset_s: float
    gaps: IntArray
    late: IntArray = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))

    def time_of(self, index: ArrayLike) -> Array:
        """Times in s at which the samples with these numbers (n,) were taken; a number may have a fraction."""
        i = np.asarray(index, dtype=float)
        if len(self.knot_index) == 1:
            return np.asarray(self.knot_time_s[0] + (i - self.knot_index[0]) * self.knot_period_s[0])
        return self._time_in(self._piece(self.knot_index, i), i)

    def times_of(self, first: int, count: int) -> Array:
        """Times in s of `count` consecutive samples from number `first` on, as `time_of` gives them.

        Each piece is found once, not for each sample; that takes a third of the time.
        """
        i = first + np.arange(count, dtype=np.float64)
        if len(self.knot_index) < 3:
            return self.time_of(i)
        out, edges = np.empty(count), [0, *np.searchsorted(i, self.knot_index[1:-1]).tolist(), count]
        for k, (a, b) in enumerate(itertools.pairwise(edges)):
            if b > a:
                out[a:b] = self._time_in(k, i[a:b])
        return out

    def _time_in(self, k: IntArray | int, i: Array) -> Array:
        """Times of the sample numbers `i`, which lie in the pieces `k`."""
        width = self.knot_index[k + 1] - self.knot_index[k]
        x = (i - self.knot_index[k]) / width
        inside = np.minimum(np.maximum(x, 0.0), 1.0)  # np.clip and np.where are slow for a few values
        y0, y1 = self.knot_time_s[k], self.knot_time_s[k + 1]
        d0, d1 = self.knot_period_s[k] * width, self.knot_period_s[k + 1] * width
        rise = y1 - y0
        cubic = y0 + inside * (d0 + inside * (3 * rise - 2 * d0 - d1 + inside * (d0 + d1 - 2 * rise)))
        return np.asarray(cubic + np.minimum(x, 0.0) * d0 + np.maximum(x - 1.0, 0.0) * d1)

    def index_of(self, time_s: ArrayLike) -> Array:
        """Sample numbers (with fraction) at these times (n,) in s: the inverse of `time_of`."""
        t = np.asarray(time_s, dtype=float)
        if len(self.knot_index) == 1:
            return np.asarray(self.knot_index[0] + (t - self.knot_time_s[0]) / self.knot_period_s[0])
        k = self._piece(self.knot_time_s, t)
        slope = (self.knot_time_s[k + 1] - self.knot_time_s[k]) / (self.knot_index[k + 1] - self.knot_index[k])
        index = self.knot_index[k] + (t - self.knot_time_s[k]) / slope
        for _ in range(3):  # the period changes by less than 1 % within a piece: each iteration gains two digits
            index = index + (t - self.time_of(index)) / slope
        return np.asarray(index)

    def stretched(self, rate: float, at_s: float) -> ClockFit:
        """The same clock on another time scale: it runs faster by `rate` (s/s) and agrees with this one at `at_s`."""
        return replace(
            self,
            knot_time_s=self.knot_time_s + rate * (self.knot_time_s - at_s),
            knot_period_s=self.knot_period_s * (1.0 + rate),
            rate_hz=self.rate_hz / (1.0 + rate),
            offset_s=self.offset_s + rate * (self.offset_s - at_s),
        )

    def bent(self, bend_s: Array) -> ClockFit:
        """The same clock with the first and the second Legendre polynomial over the time of its knots, times `bend_s`
        (2,) in s, added to its times. Their mean over this time is 0."""
        half_s = 0.5 * (self.knot_time_s[-1] - self.knot_time_s[0])
        x = (self.knot_time_s - self.knot_time_s[0]) / half_s - 1.0
        return replace(
            self,
            knot_time_s=self.knot_time_s + bend_s[0] * x + bend_s[1] * (1.5 * x**2 - 0.5),
            knot_period_s=self.knot_period_s * (1.0 + (bend_s[0] + 3.0 * bend_s[1] * x) / half_s),
        )

    @staticmethod
    def _piece(knots: Array, at: Array) -> IntArray | int:
        """Number of the piece in which each of `at` lies. A live clock has one piece, so no search is needed."""
        if len(knots) == 2:
            return 0
        return np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)


class ClockModel:
    """Clock model of one device. `update` takes the arrivals of its bursts, `result` gives the clock. Deterministic.

    `horizon_s`: bursts that are older are forgotten.
    """

    def __init__(self, nominal_rate_hz: float, horizon_s: float = HORIZON_S) -> None:
        if not nominal_rate_hz > 0:
            raise ValueError(f"nominal rate must be above 0 Hz, is {nominal_rate_hz} Hz")
        self._nominal_rate_hz = nominal_rate_hz
        self.horizon_s = horizon_s
        self.restart()

    def restart(self) -> None:
        """Forget all bursts, because the sample numbers before and after this moment are not comparable."""
        self._index = np.empty(0, dtype=np.int64)
        self._arrival_s = np.empty(0)
        self._new: list[tuple[IntArray, Array]] = []  # not joined to them yet

    def update(self, sample_index_after_burst: ArrayLike, arrival_s: ArrayLike) -> None:
        """Take B bursts: the number of the newest sample in each (B,), and its arrival time in s (B,); both rise."""
        self._new.append((np.asarray(sample_index_after_burst, np.int64), np.asarray(arrival_s, np.float64)))
        if len(self._new) == MOST_NEW:
            self._join()

    def _join(self) -> None:
        """Join the new bursts to those of the last minute, all at once: to do so with each block takes far longer."""
        if not self._new:
            return
        self._index = np.concatenate([self._index, *(index for index, _ in self._new)])
        self._arrival_s = np.concatenate([self._arrival_s, *(arrival_s for _, arrival_s in self._new)])
        self._new = []
        # Where a sample is missing within a burst, the burst comes in parts, and only the last part came without delay.
        later = self._arrival_s[1:] != self._arrival_s[:-1]
        if not later.all():
            last = np.append(later, True)
            self._index, self._arrival_s = self._index[last], self._arrival_s[last]
        if len(self._index):
            oldest = np.searchsorted(self._arrival_s, self._arrival_s[-1] - self.horizon_s)
            first = max(int(oldest), len(self._index) - MAX_BURSTS)
            self._index, self._arrival_s = self._index[first:], self._arrival_s[first:]

    def result(self) -> ClockFit:
        """The clock, estimated from the bursts of the last minute. Raises ValueError before the first burst."""
        self._join()
        if not len(self._index):
            raise ValueError("no burst yet: call update() with at least one burst before result()")
        return parabola(self._index, self._arrival_s, self._nominal_rate_hz).clock(self._index[0], self._index[-1])

    def nominal(self) -> ClockFit:
        """The clock at the nominal rate under which the newest burst came at once. There must be a burst."""
        self._join()
        newest, period_s = self._index[-1], 1.0 / self._nominal_rate_hz
        unknown = np.diag([period_s, 0.01 * period_s, 0.0]) ** 2
        line = Parabola(int(newest), float(self._arrival_s[-1]), np.array([0.0, period_s, 0.0]), unknown)
        return line.clock(newest, newest)

    def lateness_s(self, clock: ClockFit) -> Array:
        """(B,) delay in s of each burst of the last minute: its arrival time less the time of its newest sample by
        `clock`."""
        self._join()
        return np.asarray(self._arrival_s - clock.time_of(self._index))

    def snapshot(self) -> dict[str, float | IntArray | Array]:
        """The complete state, for `restore`; bit for bit."""
        self._join()
        return {
            "nominal_rate_hz": self._nominal_rate_hz,
            "horizon_s": self.horizon_s,
            "index": self._index.copy(),
            "arrival_s": self._arrival_s.copy(),
        }

    @classmethod
    def restore(cls, snapshot: Mapping[str, float | IntArray | Array]) -> ClockModel:
        """A model that gives the same results, bit for bit, as the model that made the snapshot."""
        model = cls(float(snapshot["nominal_rate_hz"]), float(snapshot["horizon_s"]))
        model._index = np.array(snapshot["index"], dtype=np.int64)
        model._arrival_s = np.array(snapshot["arrival_s"], dtype=np.float64)
        return model


@dataclass(frozen=True, slots=True, eq=False)
class Parabola:
    """Time of a sample over its number: `time_s + c0 + c1 x + c2 x^2`, where x = sample number - `index`."""

    index: int
    time_s: float
    coefficients: Array  # (3,) s, s per sample, s per sample squared
    covariance: Array  # (3, 3)
    late: IntArray = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))  # as in ClockFit

    def at(self, index: ArrayLike) -> Array:
        """Time in s of these sample numbers (n,)."""
        x = np.asarray(index, dtype=float) - self.index
        c = self.coefficients
        return np.asarray(self.time_s + (c[0] + x * (c[1] + x * c[2])))

    def period_at(self, index: ArrayLike) -> Array:
        """Sample period in s at these sample numbers (n,)."""
        x = np.asarray(index, dtype=float) - self.index
        return np.asarray(self.coefficients[1] + 2 * x * self.coefficients[2])

    def clock(self, first: int, last: int) -> ClockFit:
        """The parabola as a clock with knots at the samples `first` and `last`."""
        knots = np.array(sorted({float(first), float(last)}))
        period = float(self.period_at(last))
        at_last = np.array([1.0, last - self.index, (last - self.index) ** 2])
        slope = np.array([0.0, 1.0, 2.0 * (last - self.index)])
        return ClockFit(
            knot_index=knots,
            knot_time_s=self.at(knots),
            knot_period_s=self.period_at(knots),
            index=int(last),
            rate_hz=1.0 / period,
            u_rate_hz=float(np.sqrt(slope @ self.covariance @ slope)) / period**2,
            offset_s=float(self.at(last)),
            u_offset_s=float(np.sqrt(at_last @ self.covariance @ at_last)),
            gaps=np.empty(0, dtype=np.int64),
            late=self.late,
        )


def parabola(index: IntArray, arrival_s: Array, nominal_rate_hz: float, edge: Edge = "early") -> Parabola:
    """The parabola below the arrivals of the bursts (`edge` "early"), or through them if they scatter to both sides
    ("mean").

    `index` (B,) is the number of the newest sample of each burst, `arrival_s` (B,) its arrival in s; both rise, B >= 1.
    The curvature is 0 if the arrivals span less than `CURVED_FROM_S`.
    """
    x, y = (index - index[-1]).astype(float), arrival_s - arrival_s[-1]
    size = min(max(len(x) // GROUPS, SMALLEST_GROUP), LARGEST_GROUP)
    known = len(x) >= FEWEST_FOR_RATE
    c = np.array([0.0, y[0] / x[0] if known else 1.0 / nominal_rate_hz, 0.0])
    order = 3 if y[0] < -CURVED_FROM_S else 2
    groups = len(x) // size
    if groups < 3 or not known:
        late = y - c[1] * x
        c[0] = late.min()
        # Too few groups for a fit: u(offset) is the spread of the arrivals, u(rate) is 1 %.
        u = np.array([np.ptp(late) + 1.0 / nominal_rate_hz, 0.01 / nominal_rate_hz, 0.0])
        return Parabola(int(index[-1]), float(arrival_s[-1]), c, np.diag(u**2))
    scale = np.array([1.0, -x[0], x[0] ** 2])[:order]
    covariance = np.zeros((3, 3))
    # The points of the lower edge depend on the slope that is subtracted first; three iterations settle to a few us.
    for _ in range(1 if edge == "mean" else 3):
        late = y - (c[0] + x * (c[1] + x * c[2]))
        at, value = _edges(
            x[-groups * size :].reshape(groups, size), late[-groups * size :].reshape(groups, size), edge
        )
        on_time = _on_time(at, value) if edge == "early" else np.ones(groups, dtype=bool)
        change, spread = _robust_line(np.vander(at[on_time] / scale[1], order, increasing=True), value[on_time])
        c[:order] += change / scale
        covariance[:order, :order] = spread / np.outer(scale, scale)
    late = _late_samples(index, y - (c[0] + x * (c[1] + x * c[2])), value[~on_time])
    return Parabola(int(index[-1]), float(arrival_s[-1]), c, covariance, late)


def _late_samples(index: IntArray, late: Array, by_s: Array) -> IntArray:
    """(k, 2) the first and the last sample of bursts, late by (B,) in s, that are at least half as late as the latest
    of the groups that were left out, late by (L,)."""
    least_s = 0.5 * np.max(by_s, initial=0.0)
    found = np.flatnonzero(late[1:] > least_s) if least_s > LATE_S else np.empty(0, dtype=np.int64)
    return np.column_stack([index[found] + 1, index[found + 1]])


def _on_time(at: Array, value: Array) -> NDArray[np.bool_]:
    """Which groups of bursts, with their edges (G,) in s at sample numbers (G,), did not arrive late as a whole, and
    have no such neighbour: the delay begins or ends within that one."""
    if np.ptp(value) <= LATE_S:
        return np.ones(len(value), dtype=bool)
    # A delay that begins or ends is in few of the slopes of neighbours, wherever it is.
    late = value - at * median((value[2:] - value[:-2]) / (at[2:] - at[:-2]))
    usual = float(np.partition(late, int(ON_TIME * len(late)))[int(ON_TIME * len(late))])
    scatter = 1.4826 * float(median(np.abs(np.diff(late)))) / np.sqrt(2.0)
    off = np.abs(late - usual) > max(LATE_S, LATE_SD * scatter)
    on_time = ~(off | np.append(off[1:], False) | np.append(False, off[:-1]))
    return on_time if np.count_nonzero(on_time) >= max(FEWEST_ON_TIME, ON_TIME * len(late)) else np.ones_like(on_time)


def _edges(x: Array, late: Array, edge: Edge) -> tuple[Array, Array]:
    """For each group of bursts (G, n): the sample number of its lower edge, and the lateness in s there (G,).

    The lower edge lies below the earliest arrival by as much, on average, as the second earliest lies above it (Robson
    and Whitlock 1964).
    """
    if edge == "mean":
        return x.mean(axis=1), late.mean(axis=1)
    two = np.partition(late, 1, axis=1)
    return x[np.arange(len(x)), late.argmin(axis=1)], 2 * two[:, 0] - two[:, 1]


def _robust_line(design: Array, value: Array) -> tuple[Array, Array]:
    """Coefficients and their covariance by least squares in which late groups have little weight."""
    weight = np.ones(len(value))
    for _ in range(3):
        weighted = design * weight[:, None]
        inverse = _inverse(weighted.T @ weighted)
        c = inverse @ (weighted.T @ (weight * value))
        rest = value - design @ c
        sd = 1.4826 * float(median(np.abs(rest))) + 1e-12
        weight = np.sqrt(sd / np.maximum(rest, sd))
    return c, np.asarray(inverse * sd**2)


def _inverse(normal: Array) -> Array:
    """The inverse of a symmetric matrix (2, 2) or (3, 3) by its cofactors, in a third of the time of np.linalg.inv.

    Raises numpy.linalg.LinAlgError for a singular matrix.
    """
    if len(normal) == 2:
        (a, b), (_, d) = normal.tolist()
        rows = [[d, -b], [-b, a]]
        determinant = a * d - b * b
    else:
        (a, b, c), (_, d, e), (_, _, f) = normal.tolist()
        first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
        rows = [[first, second, third], [second, a * f - c * c, b * c - a * e], [third, b * c - a * e, a * d - b * b]]
        determinant = a * first + b * second + c * third
    if determinant == 0.0:
        raise np.linalg.LinAlgError("singular matrix")
    return np.asarray(np.array(rows) / determinant)
