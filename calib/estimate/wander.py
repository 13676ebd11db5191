"""How S, Q and what moves the data may change between windows: random walks, a steady drift, temperature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.model import PARAMETERS, Array

RATES = ("Qx_rate", "Qy_rate", "Qz_rate")  # output unit a day
MAIN_TEMPERATURE = ("Sx_T1", "Sy_T1", "Sz_T1")  # of a row of S, relative per K


def offset_temperature(power: int) -> tuple[str, str, str]:
    """Names of the coefficients of Q on (T - T0)^power, output unit per K^power."""
    return f"Qx_T{power}", f"Qy_T{power}", f"Qz_T{power}"


@dataclass(frozen=True, slots=True)
class Wander:
    """Standard deviations of random walks after one day (they grow with the square root of time).

    `sensitivity` relative to the scale of S, `offset_mps2`, `tilt_rad` of gravity at a fixed mount, `reference`
    relative; `offset_rate_mps2` (a day) is the first uncertainty of the steady drift of Q and `offset_rate_walk_mps2`
    how that rate wanders. Wandering never makes a parameter less known than it was before any data.
    """

    sensitivity: float = 5e-5
    offset_mps2: float = 0.002
    offset_rate_mps2: float = 0.001
    offset_rate_walk_mps2: float = 2e-5
    tilt_rad: float = 3.5e-5
    reference: float = 0.0

    def variance_a_day(self, names: list[str], scale: float, tilted_mps2: float) -> Array:
        """(N,) of named quantities; `scale` is the sensor's output unit per m/s2, `tilted_mps2` the gravity of which a
        tilt of the mount moves the mean output: 0 where Q itself is meant."""
        found = np.zeros(len(names))
        for k, name in enumerate(names):
            if name in PARAMETERS[:9]:
                found[k] = (self.sensitivity * scale) ** 2
            elif name in PARAMETERS[9:]:
                found[k] = (self.offset_mps2**2 + (tilted_mps2 * self.tilt_rad) ** 2) * scale**2
            elif name in RATES:
                found[k] = (self.offset_rate_walk_mps2 * scale) ** 2
            elif name.startswith(("gravity_x", "gravity_y", "gravity_z", "tilt_")):
                found[k] = self.tilt_rad**2
            elif name.startswith("reference"):
                found[k] = self.reference**2
        return found


@dataclass(frozen=True, slots=True)
class TemperatureModel:
    """Polynomial of Q, and if the order is 1 of S, about a reference temperature, with first uncertainties.

    Q(T) = Q + sum_k c_k (T - T0)^k, k = 1 .. `offset_order` (0: Q is constant); row i of S is multiplied by
    1 + d_i (T - T0).
    """

    offset_order: int = 0
    sensitivity_order: int = 0
    reference_degc: float = 20.0
    u_offset_mps2: tuple[float, float] = (0.01, 2e-4)  # per K, per K2
    u_sensitivity: float = 2e-4  # per K

    def terms(self, scale: float) -> list[tuple[str, float]]:
        """(name, first standard uncertainty) of its coefficients."""
        found = [
            (name, u * scale)
            for power, u in enumerate(self.u_offset_mps2[: self.offset_order], start=1)
            for name in offset_temperature(power)
        ]
        return found + [(name, self.u_sensitivity) for name in MAIN_TEMPERATURE[: 3 * self.sensitivity_order]]
