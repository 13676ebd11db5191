"""Tells a unit that was not stated from the size of gravity in it."""

from __future__ import annotations

import math

import numpy as np

from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.recorded.errors import UnitError
from calib.recorded.table import ReferenceTable

# How large gravity is in units that are taken for m/s2.
GRAVITY_IN = {"g": 1.0, "mg": 1000.0, "cm/s2": 100 * STANDARD_GRAVITY_MPS2, "mm/s2": 1000 * STANDARD_GRAVITY_MPS2}
NEAR = 0.05  # relative: offsets of a sensor in g are not larger
ROWS = 100_000  # spread over the file
ROWS_AT_ONCE = 1000  # of them


def unit_hint(length: float) -> str:
    """A hint if a vector of gravity with this length is in another unit than m/s2, otherwise ""."""
    unit = _unit(length)
    return f"; values of about {GRAVITY_IN[unit]:.4g} at rest are in {unit}" if unit else ""


def check_gravity(reference: ReferenceTable) -> None:
    """Refuse a tri-axial reference that feels gravity as in another unit. Raises UnitError with the unit."""
    if reference.channels != 3:
        return
    x, step = reference.x, -(-len(reference.x) // ROWS)
    some = [x[first : first + ROWS_AT_ONCE * step : step] for first in range(0, len(x), ROWS_AT_ONCE * step)]
    length = float(np.nanmedian(np.linalg.norm(np.concatenate(some), axis=1)))
    if unit := _unit(length):
        raise UnitError(
            f"the median magnitude is {length:.4g} m/s2, but gravity has 9.8{unit_hint(length)}",
            unit, place=reference.place, column=reference.column, value=length,
        )  # fmt: skip


def _unit(length: float) -> str:
    return next((name for name, g in GRAVITY_IN.items() if math.isclose(length, g, rel_tol=NEAR)), "")
