"""Sample times of a device from when its samples arrived: a clock model, since stamps are arrivals, not truth.

The newest sample of a burst was taken before the burst arrived, never after it: lateness is one-sided, and so are a
poll's phase, a transport's delay and a stall. So the model follows the *earliest* arrivals: a parabola under the last
minute's points (arrival over sample number), at the edge that the two earliest of every group of bursts point to. The
constant part of the lateness (a bus transfer, say) shows in no arrival; it is part of the lag the adjustment estimates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.model import Array

IntArray = NDArray[np.int64]
# A minute holds 3000 bursts of a usual driver; a thermal swing of 250 ppm in 30 min is a parabola within it to 1 us.
HORIZON_S = 60.0
MAX_BURSTS = 8192  # bounds memory and work for a device that sends a burst a sample
# Bursts in a group whose earliest two are used: fewer follow them less closely, more leave too few groups.
GROUPS, SMALLEST_GROUP, LARGEST_GROUP = 16, 8, 64
CURVED_FROM_S = 20.0  # before, a straight line is nearer: the curvature's own uncertainty costs more than it brings
FEWEST_FOR_RATE = 20  # bursts; before, the nominal rate is the better guess

Edge = Literal["early", "mean"]


@dataclass(frozen=True, slots=True, eq=False)
class ClockFit:
    """Sample times of a device: cubic pieces between knots (K,), straight on beyond the ends.

    `rate_hz` and `offset_s` (the time of sample `index`) are those at the newest sample, with standard uncertainties;
    these do not contain the constant part of the lateness. `gaps` are the sample numbers before which samples are
    missing.
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

    def time_of(self, index: ArrayLike) -> Array:
        """When the samples of these numbers (n,) were taken, in s; fractions of a number are allowed."""
        i = np.asarray(index, dtype=float)
        if len(self.knot_index) == 1:
            return np.asarray(self.knot_time_s[0] + (i - self.knot_index[0]) * self.knot_period_s[0])
        k = self._piece(self.knot_index, i)
        width = self.knot_index[k + 1] - self.knot_index[k]
        x = (i - self.knot_index[k]) / width
        inside = np.clip(x, 0.0, 1.0)
        y0, y1 = self.knot_time_s[k], self.knot_time_s[k + 1]
        d0, d1 = self.knot_period_s[k] * width, self.knot_period_s[k + 1] * width
        rise = y1 - y0
        cubic = y0 + inside * (d0 + inside * (3 * rise - 2 * d0 - d1 + inside * (d0 + d1 - 2 * rise)))
        return np.asarray(cubic + (x - inside) * np.where(x < 0.0, d0, d1))

    def index_of(self, time_s: ArrayLike) -> Array:
        """Sample number (with fraction) at these times (n,): the inverse of `time_of`."""
        t = np.asarray(time_s, dtype=float)
        if len(self.knot_index) == 1:
            return np.asarray(self.knot_index[0] + (t - self.knot_time_s[0]) / self.knot_period_s[0])
        k = self._piece(self.knot_time_s, t)
        slope = (self.knot_time_s[k + 1] - self.knot_time_s[k]) / (self.knot_index[k + 1] - self.knot_index[k])
        index = self.knot_index[k] + (t - self.knot_time_s[k]) / slope
        for _ in range(3):  # periods differ by less than 1e-2 within a piece: each turn gains two digits or more
            index = index + (t - self.time_of(index)) / slope
        return np.asarray(index)

    def stretched(self, rate: float, at_s: float) -> ClockFit:
        """The clock as it is on a time scale that runs faster by `rate` (s a second) and agrees with this one at
        `at_s`."""
        return replace(
            self,
            knot_time_s=self.knot_time_s + rate * (self.knot_time_s - at_s),
            knot_period_s=self.knot_period_s * (1.0 + rate),
            rate_hz=self.rate_hz / (1.0 + rate),
            offset_s=self.offset_s + rate * (self.offset_s - at_s),
        )

    @staticmethod
    def _piece(knots: Array, at: Array) -> IntArray | int:
        """In which piece these are; of a live clock there is one, and nothing need be looked up for each sample."""
        if len(knots) == 2:
            return 0
        return np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)


class ClockModel:
    """Clock of one device, fed with its bursts as they come. Deterministic; `result` reads, `update` changes."""

    def __init__(self, nominal_rate_hz: float, horizon_s: float = HORIZON_S) -> None:
        if not nominal_rate_hz > 0:
            raise ValueError(f"nominal rate must be above 0 Hz, is {nominal_rate_hz}")
        self._nominal_rate_hz = nominal_rate_hz
        self._horizon_s = horizon_s
        self.restart()

    def restart(self) -> None:
        """Forget everything: the sample numbers do not go on in time."""
        self._index = np.empty(0, dtype=np.int64)
        self._arrival_s = np.empty(0)

    def update(self, sample_index_after_burst: ArrayLike, arrival_s: ArrayLike) -> None:
        """Take bursts (B,): the number of the newest sample in each, and when the burst arrived, both rising."""
        self._index = np.concatenate([self._index, np.asarray(sample_index_after_burst, dtype=np.int64)])
        self._arrival_s = np.concatenate([self._arrival_s, np.asarray(arrival_s, dtype=float)])
        if len(self._index):
            oldest = np.searchsorted(self._arrival_s, self._arrival_s[-1] - self._horizon_s)
            first = max(int(oldest), len(self._index) - MAX_BURSTS)
            self._index, self._arrival_s = self._index[first:], self._arrival_s[first:]

    def result(self) -> ClockFit:
        """The clock as the bursts of the last minute show it. Raises ValueError before the first burst."""
        if not len(self._index):
            raise ValueError("no burst yet")
        return parabola(self._index, self._arrival_s, self._nominal_rate_hz).clock(self._index[0], self._index[-1])

    def nominal(self) -> ClockFit:
        """The clock at the nominal rate under which the newest burst came at once. There must be a burst."""
        newest, period_s = self._index[-1], 1.0 / self._nominal_rate_hz
        unknown = np.diag([period_s, 0.01 * period_s, 0.0]) ** 2
        line = Parabola(int(newest), float(self._arrival_s[-1]), np.array([0.0, period_s, 0.0]), unknown)
        return line.clock(newest, newest)

    def lateness_s(self, clock: ClockFit) -> Array:
        """How late each burst of the last minute arrived (B,): its arrival less the time that `clock` gives its newest
        sample, in s."""
        return np.asarray(self._arrival_s - clock.time_of(self._index))

    def snapshot(self) -> dict[str, float | IntArray | Array]:
        """All of the state, exactly."""
        return {
            "nominal_rate_hz": self._nominal_rate_hz,
            "horizon_s": self._horizon_s,
            "index": self._index.copy(),
            "arrival_s": self._arrival_s.copy(),
        }

    @classmethod
    def restore(cls, snapshot: Mapping[str, float | IntArray | Array]) -> ClockModel:
        """A model that goes on as the one whose snapshot this is, bit for bit."""
        model = cls(float(snapshot["nominal_rate_hz"]), float(snapshot["horizon_s"]))
        model._index = np.array(snapshot["index"], dtype=np.int64)
        model._arrival_s = np.array(snapshot["arrival_s"], dtype=np.float64)
        return model


@dataclass(frozen=True, slots=True, eq=False)
class Parabola:
    """Time over sample number near `index`: `time_s + c0 + c1 x + c2 x^2`, x = sample number - `index`."""

    index: int
    time_s: float
    coefficients: Array  # (3,) s, s per sample, s per sample squared
    covariance: Array  # (3, 3)

    def at(self, index: ArrayLike) -> Array:
        """Time in s."""
        x = np.asarray(index, dtype=float) - self.index
        c = self.coefficients
        return np.asarray(self.time_s + (c[0] + x * (c[1] + x * c[2])))

    def period_at(self, index: ArrayLike) -> Array:
        """Sample period in s."""
        x = np.asarray(index, dtype=float) - self.index
        return np.asarray(self.coefficients[1] + 2 * x * self.coefficients[2])

    def clock(self, first: int, last: int) -> ClockFit:
        """As a clock from sample `first` to sample `last`."""
        knots = np.unique(np.array([first, last], dtype=float))
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
        )


def parabola(index: IntArray, arrival_s: Array, nominal_rate_hz: float, edge: Edge = "early") -> Parabola:
    """The parabola under the bursts' arrivals (`early`), or through them where they scatter both ways (`mean`).

    `index`, `arrival_s` (B,) rising, B >= 1; a straight line where they span less than `CURVED_FROM_S`.
    """
    x, y = (index - index[-1]).astype(float), arrival_s - arrival_s[-1]
    size = int(np.clip(len(x) // GROUPS, SMALLEST_GROUP, LARGEST_GROUP))
    known = len(x) >= FEWEST_FOR_RATE
    c = np.array([0.0, y[0] / x[0] if known else 1.0 / nominal_rate_hz, 0.0])
    order = 3 if y[0] < -CURVED_FROM_S else 2
    groups = len(x) // size
    if groups < 3 or not known:
        late = y - c[1] * x
        c[0] = late.min()
        # Until the groups show more: anywhere within the spread of the arrivals, and the rate 1 % off.
        u = np.array([np.ptp(late) + 1.0 / nominal_rate_hz, 0.01 / nominal_rate_hz, 0.0])
        return Parabola(int(index[-1]), float(arrival_s[-1]), c, np.diag(u**2))
    scale = np.array([1.0, -x[0], x[0] ** 2])[:order]
    covariance = np.zeros((3, 3))
    for _ in range(
        1 if edge == "mean" else 3
    ):  # the groups' edges depend on the slope taken out first: settles to some us
        late = y - (c[0] + x * (c[1] + x * c[2]))
        at, value = _edges(
            x[-groups * size :].reshape(groups, size), late[-groups * size :].reshape(groups, size), edge
        )
        change, spread = _robust_line(np.vander(at / scale[1], order, increasing=True), value)
        c[:order] += change / scale
        covariance[:order, :order] = spread / np.outer(scale, scale)
    return Parabola(int(index[-1]), float(arrival_s[-1]), c, covariance)


def _edges(x: Array, late: Array, edge: Edge) -> tuple[Array, Array]:
    """For each group (G, n): where its edge stands and how late it is (G,).

    The gap between the earliest two is as large, on average, as the one before the earliest (Robson and Whitlock 1964).
    """
    if edge == "mean":
        return x.mean(axis=1), late.mean(axis=1)
    two = np.argpartition(late, 1, axis=1)[:, :2]
    values = np.take_along_axis(late, two, axis=1)
    earliest = two[np.arange(len(two)), values.argmin(axis=1)]
    return x[np.arange(len(x)), earliest], 2 * values.min(axis=1) - values.max(axis=1)


def _robust_line(design: Array, value: Array) -> tuple[Array, Array]:
    """Least squares that late groups do not pull: coefficients and their covariance."""
    weight = np.ones(len(value))
    for _ in range(3):
        weighted = design * weight[:, None]
        inverse = np.linalg.inv(weighted.T @ weighted)
        c = inverse @ (weighted.T @ (weight * value))
        rest = value - design @ c
        sd = 1.4826 * float(np.median(np.abs(rest))) + 1e-12
        weight = np.where(rest > sd, np.sqrt(sd / np.maximum(rest, sd)), 1.0)
    return c, np.asarray(inverse * sd**2)
