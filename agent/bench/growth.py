"""How U of a sensor grows after a visit, until the next: random walks, a steady drift of Q, and temperature."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from agent.config import Channel
from calib.estimate.quantities import YEAR_DAYS
from calib.model import Array, scale_of
from calib.visit.next_stop import COVERAGE_FACTOR

MONTHS = (0, 1, 3, 6, 12)
MONTH_DAYS = YEAR_DAYS / 12.0
FURTHEST_DAYS = 20.0 * YEAR_DAYS
MAIN_OF_12 = np.array([0, 4, 8])


@dataclass(frozen=True, slots=True, eq=False)
class Growth:
    """U of one sensor after a visit, as its configuration states how S and Q may change.

    `sensitivity` (3, 3) and `variance` (12,) are those of the visit, `u_after` of S and Q by the time. `off_k`: the SD
    by which the temperature differs from that of the visit.
    """

    channel: Channel
    sensitivity: Array
    variance: Array
    off_k: float

    def variance_after(self, days: float) -> Array:
        """(12,) of S and Q, in the squares of their units."""
        c, scale = self.channel, scale_of(self.sensitivity.ravel())
        t, u_rate = c.temperature, np.full(3, scale * c.process.offset_rate_mps2)
        grown = c.wander().variance_after(days, scale, c.gravity_mps2, u_rate)
        if days > 0.0:
            grown[:9] += (t.u_sensitivity_pct_per_k / 100.0 * self.off_k * self.sensitivity.ravel()) ** 2
            grown[9:] += (scale * t.u_offset_mps2_per_k * self.off_k) ** 2
        return np.asarray(self.variance + grown)

    def main_pct(self, days: float) -> float:
        """U (k = 2) of the worst main sensitivity after so many days, %."""
        u = np.sqrt(self.variance_after(days)[MAIN_OF_12]) / np.abs(np.diag(self.sensitivity))
        return float(100.0 * COVERAGE_FACTOR * u.max())

    def offset_mps2(self, days: float) -> float:
        """U (k = 2) of the worst offset after so many days, in m/s2."""
        u = np.sqrt(self.variance_after(days)[9:]) / np.abs(np.diag(self.sensitivity))
        return float(COVERAGE_FACTOR * u.max())

    def days_until(self, limit_pct: float) -> float | None:
        """Days until U of a main sensitivity exceeds the limit; 0 if it does at once, None if not in 20 years."""
        if self.main_pct(np.finfo(float).tiny) > limit_pct:
            return 0.0
        if self.main_pct(FURTHEST_DAYS) <= limit_pct:
            return None
        low, high = 0.0, FURTHEST_DAYS
        while high - low > 0.5:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self.main_pct(middle) > limit_pct else (middle, high)
        return low

    def as_object(self, limit_pct: float, now: datetime) -> dict[str, Any]:
        """The members of the JSON object."""
        days = self.days_until(limit_pct)
        after = [
            {
                "months": m,
                "u_main_pct": self.main_pct(m * MONTH_DAYS),
                "u_offset_mps2": self.offset_mps2(m * MONTH_DAYS),
            }
            for m in MONTHS
        ]
        exceeded = None if days is None else (now + timedelta(days=days)).date().isoformat()
        return {"after": after, "limit_pct": limit_pct, "exceeded_on": exceeded, "temperature_off_k": self.off_k}


def growth(channel: Channel, result: dict[str, Any], off_k: float) -> Growth:
    """The growth of a result of `fieldcal calibrate`. What it does not tell of Q is as large as it was before."""
    S = np.array(result["sensitivity"], dtype=float)
    u = np.append(
        np.array(result["standard_uncertainty"]["sensitivity"], dtype=float).ravel(),
        np.array(result["standard_uncertainty"]["offset"], dtype=float),
    )
    return Growth(channel, S, u**2, off_k)
