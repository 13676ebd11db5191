"""Changes of S, Q and the nuisances between windows: random walks, a steady drift of Q, and temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calib.estimate.joint_state import JointState
from calib.estimate.quantities import (
    ALL_RATES,
    MAIN_TEMPERATURE,
    OFFSET,
    OFFSET_TEMPERATURE,
    SENSITIVITY_TEMPERATURE,
    TILT_WALK,
    WALKS,
    Quantity,
    Stated,
    Statement,
    offset_temperature,
)
from calib.model import Array


@dataclass(frozen=True, init=False)
class Wander(Stated):
    """Standard deviations of random walks after one day; they grow with the square root of time.

    Each number is an attribute; calib.estimate.quantities has the names and defaults. `offset_rate_mps2` (per day) is
    the standard uncertainty of the steady drift of Q before any data, `offset_rate_walk_mps2` the random walk of that
    rate. A random walk never makes the uncertainty of a parameter larger than it was before any data.
    """

    table: ClassVar[Mapping[str, Statement]] = WALKS

    def variance_a_day(self, quantities: Sequence[Quantity], scale: float, tilted_mps2: float) -> Array:
        """(N,) variance per day of the random walk of each quantity, in the square of its unit.

        `scale` is the sensor's output unit per m/s2. `tilted_mps2` is the gravity by which a tilt of the mount changes
        the mean output; 0 if the walk of Q alone is wanted.
        """
        found = np.zeros(len(quantities))
        for k, quantity in enumerate(quantities):
            kind = quantity.kind
            if quantity.first:
                continue
            if kind is OFFSET:
                tilted = tilted_mps2 * self.of(TILT_WALK)
                found[k] = (self.of(kind.walk) ** 2 + tilted**2) * scale**2
            else:
                found[k] = (self.of(kind.walk) * (scale if kind.in_output_unit else 1.0)) ** 2
        return found


def wandered(state: JointState, days: float, variance_a_day: Array, bound: Array) -> JointState:
    """A copy of the state `days` later: S and Q have drifted by their rates, and walks have increased the variances.

    `variance_a_day` (N,) is the variance per day of each random walk; no variance grows beyond `bound` (N,).
    """
    state = state.copy()
    if days > 0.0:
        drift = np.eye(len(state))
        for p, name in enumerate(ALL_RATES):
            if name in state:
                drift[p, state.index(name)] = days
        state.transform(drift)
        state.spread(np.minimum(variance_a_day * days, np.maximum(bound - state.variance, 0.0)))
    return state


@dataclass(frozen=True, slots=True)
class TemperatureModel:
    """Dependence of S and Q on the temperature T, with the standard uncertainties of the coefficients before any data.

    Q(T) = Q + sum_k c_k (T - T0)^k, k = 1 .. `offset_order` (0: Q does not depend on T). If `sensitivity_order` is 1,
    row i of S is multiplied by 1 + d_i (T - T0). T0 is `reference_degc`.
    """

    offset_order: int = 0
    sensitivity_order: int = 0
    reference_degc: float = 20.0
    u_offset_mps2: tuple[float, float] = (0.01, 2e-4)  # per K, per K2
    u_sensitivity: float = 2e-4  # per K

    def terms(self, scale: float) -> list[tuple[Quantity, float]]:
        """Its coefficients, each with its standard uncertainty before any data; `scale` is output unit per m/s2."""
        found = [
            (Quantity(name, OFFSET_TEMPERATURE), u * scale)
            for power, u in enumerate(self.u_offset_mps2[: self.offset_order], start=1)
            for name in offset_temperature(power)
        ]
        rows = MAIN_TEMPERATURE[: 3 * self.sensitivity_order]
        return found + [(Quantity(name, SENSITIVITY_TEMPERATURE), self.u_sensitivity) for name in rows]
