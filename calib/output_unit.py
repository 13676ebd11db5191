"""The unit of a sensor's output: what people call it, and in which units they read S and Q."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import Array

ACCELERATION = "m/s²"
IN_G = "g/g"  # S of an output in g
G_IN = {"g": 1.0, "mg": 1e3, "µg": 1e6}  # how many of these units are 1 g
_WRITTEN = {"uV": "µV", "ug": "µg"}


@dataclass(frozen=True, slots=True)
class DisplayUnits:
    """The units in which people read S and Q. `factors` (12,): S row by row and Q in these units for 1 in the result's.

    The unit of S is "1" where it has no dimension.
    """

    sensitivity: str
    offset: str
    factors: Array

    @property
    def words(self) -> str:
        """Both units in words."""
        S = self.sensitivity if self.sensitivity == IN_G else f"{self.offset} per {ACCELERATION}"
        return f"S in {S}, Q in {self.offset}"


def unit_text(unit: str) -> str:
    """The unit as people write it; "output unit" where nothing tells it."""
    return _WRITTEN.get(unit, unit.replace("/s^2", "/s²").replace("/s2", "/s²")) or "output unit"


def shown_in(unit: str) -> DisplayUnits:
    """How S and Q of an output in `unit` are shown: as they are, but S in g/g and Q in mg where the output is in g."""
    name = unit_text(unit)
    if (one_g := G_IN.get(name)) is not None:
        return DisplayUnits(IN_G, "mg", _factors(STANDARD_GRAVITY_MPS2 / one_g, G_IN["mg"] / one_g))
    return DisplayUnits("1" if name == ACCELERATION else f"{name}/({ACCELERATION})", name, _factors(1.0, 1.0))


def _factors(of_sensitivity: float, of_offset: float) -> Array:
    return np.repeat([of_sensitivity, of_offset], (9, 3))
