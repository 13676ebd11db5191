"""Changes of S, Q and the nuisances between windows: random walks, a steady drift of Q, and temperature."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calib.estimate.quantities import (
    BEHIND,
    OFFSET_BEHIND,
    OFFSET_RATE,
    OFFSET_TEMPERATURE,
    S_AND_Q,
    SENSITIVITY_BEHIND,
    SENSITIVITY_PER_K,
    SENSITIVITY_TEMPERATURE,
    TILT_WALK,
    WALKS,
    Quantity,
    StatedValues,
    Statement,
    offset_temperature,
)
from calib.model import Array


@dataclass(frozen=True, init=False)
class Wander(StatedValues):
    """Standard deviations of random walks after one day; they grow with the square root of time.

    Each number is an attribute; calib.estimate.quantities has the names and defaults. `offset_rate_mps2` (per day) is
    the standard uncertainty of the steady drift of Q before any data, `offset_rate_walk_mps2` the random walk of that
    rate. A random walk never makes the uncertainty of a parameter larger than it was before any data.
    """

    table: ClassVar[Mapping[str, Statement]] = WALKS

    def variance_a_day(self, scale: float, tilted_mps2: float) -> Array:
        """(12,) variance a day of the random walks of S and Q, in the squares of their units.

        `scale` is the sensor's output unit per m/s2. `tilted_mps2` is the gravity by which a tilt of the mount changes
        the mean output; 0 if the walk of Q alone is wanted.
        """
        tilt = self.of(TILT_WALK) * tilted_mps2
        walks = np.array([self.of(quantity.kind.walk) for quantity in S_AND_Q])
        return np.asarray((walks**2 + np.append(np.zeros(9), np.full(3, tilt**2))) * scale**2)

    def variance_after(self, days: float, scale: float, tilted_mps2: float, u_rate: Array) -> Array:
        """(12,) variance that S and Q gain in so many days in which nobody looks, in the squares of their units.

        `scale`, `tilted_mps2` as in `variance_a_day`. `u_rate` (3,): by which Q may drift, in its unit a day.
        """
        grown = self.variance_a_day(scale, tilted_mps2) * days
        grown[9:] += (u_rate * days) ** 2 + (scale * self.of(OFFSET_RATE.walk)) ** 2 * days**3 / 3.0
        return grown


@dataclass(frozen=True, slots=True)
class TemperatureModel:
    """Dependence of S and Q on the temperature T, with the standard uncertainties of the coefficients before any data.

    Q(T) = Q + sum_k c_k (T - T0)^k, k = 1 .. `offset_order` (0: Q does not depend on T). If `sensitivity_order` is 1,
    S(T) = S + C (T - T0) as soon as a window tells its temperature; `u_sensitivity` is that of each element of C over
    the main sensitivity. T0 is `reference_degc`; with `settles` only until a window tells its temperature.
    """

    offset_order: int = 0
    sensitivity_order: int = 0
    reference_degc: float = 20.0
    u_offset_mps2: tuple[float, float] = (0.01, 2e-4)  # per K, per K2
    u_sensitivity: float = 2e-4  # per K
    settles: bool = False

    def of_offset(self, scale: float) -> list[tuple[Quantity, float]]:
        """Coefficients of Q, each with its standard uncertainty before any data; `scale` is output unit per m/s2."""
        return [
            (Quantity(name, OFFSET_TEMPERATURE), u * scale)
            for power, u in enumerate(self.u_offset_mps2[: self.offset_order], start=1)
            for name in offset_temperature(power)
        ]

    def of_sensitivity(self, scale: float) -> list[tuple[Quantity, float]]:
        """Those of S, row by row."""
        names = SENSITIVITY_PER_K if self.sensitivity_order else ()
        return [(Quantity(name, SENSITIVITY_TEMPERATURE), self.u_sensitivity * scale) for name in names]

    def behind(self, scale: float) -> list[tuple[Quantity, float]]:
        """Those of S and Q for a body that follows the told temperature late; with S alone, as `of_sensitivity`."""
        if not self.sensitivity_order:
            return []
        of_S = [(Quantity(name, SENSITIVITY_BEHIND), self.u_sensitivity * scale) for name in BEHIND[:9]]
        return of_S + [(Quantity(name, OFFSET_BEHIND), self.u_offset_mps2[0] * scale) for name in BEHIND[9:]]
