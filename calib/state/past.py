"""S(t), Q(t) and U(t) of the past: each epoch by all windows, those before it and those after it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.estimate.correction import Law
from calib.model import Array
from calib.signal.order_statistics import distinct
from calib.state.dating import Date

REACH_DAYS = 1.0 / 24.0  # before the first and after the last epoch S and Q are held for so long
# Between two epochs. A walk of Q by 2 mm/s2 a root day adds 2.6 mm/s2 in the middle of so long a gap.
FURTHEST_DAYS = 7.0


@dataclass(frozen=True, slots=True, eq=False)
class StatedChange:
    """What was stated to change at once on a day: a step, a remount, a calibration that an operator put in force.

    `stated`: standard uncertainties of the changes beforehand, by unknown. `found` and `standard_uncertainty` (12,): by
    how much S and Q changed, by all windows. `dated` tells when it came; it may take some seconds, the first time.
    """

    day: float
    stated: Mapping[str, float]
    found: Array
    standard_uncertainty: Array
    dated: Callable[[], Date]


@dataclass(frozen=True, slots=True, eq=False)
class Past:
    """Epochs in the order of their `days` (K,), each with its S and Q over temperature, `laws`. `windows`: how many
    were taken at each one; 0 beside a change, and within a gap. `begin`: the day of the first window, which may have
    been merged with later ones. `coverage_factor`: for about 95 %.

    An epoch just before each change and one at it stand for both sides, so that S and Q are linear between any two.
    """

    days: Array
    laws: Sequence[Law]
    windows: Sequence[int]
    changes: Sequence[StatedChange]
    begin: float
    coverage_factor: float

    def knows(self, day: float) -> bool:
        """Whether a day is between the first and the last epoch, or by REACH_DAYS at most outside."""
        return bool(len(self.days) and self.begin - REACH_DAYS <= day <= self.days[-1] + REACH_DAYS)

    def at(self, day: float) -> Law:
        """S and Q on a day: on the line between two epochs, which is the mean of a random walk between them. Its
        covariance is that of the line's ends, interpolated. Outside, those of the nearest epoch."""
        after = min(max(int(np.searchsorted(self.days, day, side="right")), 1), len(self.days) - 1)
        one, other = self.laws[after - 1], self.laws[after]
        span = self.days[after] - self.days[after - 1]
        part = float(np.clip((day - self.days[after - 1]) / span, 0.0, 1.0)) if span > 0.0 else 0.0
        mean, covariance = (
            (1.0 - part) * a + part * b for a, b in ((one.mean, other.mean), (one.covariance, other.covariance))
        )
        return replace(one, mean=mean, covariance=covariance)


def epoch_days(windows: Iterable[float], changes: Iterable[float]) -> list[float]:
    """The days of epochs beside those of windows: both sides of each change, and days within long gaps."""
    sides = [day for change in changes for day in (float(np.nextafter(change, -np.inf)), change)]
    days = distinct(np.array([*windows, *sides]))
    between = [
        np.linspace(before, after, int(np.ceil((after - before) / FURTHEST_DAYS)) + 1)[1:-1].tolist()
        for before, after in zip(days.tolist(), days.tolist()[1:], strict=False)
    ]
    return [*sides, *(day for gap in between for day in gap)]
