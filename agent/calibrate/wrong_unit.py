"""Tells a unit that was not stated from the size of gravity in it."""

from __future__ import annotations

import math

import numpy as np

from agent.calibrate.tables import ReferenceTable
from agent.reading.source import TableError
from calib.geometry import STANDARD_GRAVITY_MPS2

# How large gravity is in units that are taken for m/s2.
GRAVITY_IN = {"g": 1.0, "mg": 1000.0, "cm/s2": 100 * STANDARD_GRAVITY_MPS2, "mm/s2": 1000 * STANDARD_GRAVITY_MPS2}
NEAR = 0.05  # relative: offsets of a sensor in g are not larger
ROWS = 100_000  # spread over the file


def unit_hint(length: float) -> str:
    """A hint if a vector of gravity with this length is in another unit than m/s2, otherwise ""."""
    unit = next((name for name, g in GRAVITY_IN.items() if math.isclose(length, g, rel_tol=NEAR)), "")
    return f"; values of about {GRAVITY_IN[unit]:.4g} at rest are in {unit}" if unit else ""


def check_gravity(reference: ReferenceTable) -> None:
    """Refuse a tri-axial reference that feels gravity as in another unit. Raises TableError with the unit."""
    if reference.x.shape[1] != 3:
        return
    length = float(np.nanmedian(np.linalg.norm(reference.x[:: -(-len(reference.x) // ROWS)], axis=1)))
    if hint := unit_hint(length):
        unit = hint.rpartition(" ")[2]
        raise TableError(
            f"{reference.path}, {reference.column}: the median magnitude is {length:.4g} m/s2, but gravity has "
            f"9.8{hint}; state the unit with --reference-columns time=NAME,x=NAME:{unit},y=NAME:{unit},z=NAME:{unit}"
        )
