"""Tells a unit that was not stated from the size of gravity in it."""

from __future__ import annotations

import math

import numpy as np

from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import Array, Slices
from calib.recorded.errors import UnitError
from calib.recorded.options import Coupling
from calib.recorded.table import REFERENCES, ReferenceTable, SensorTable
from calib.recorded.units import SI_NAMES

# How large gravity is in units that are taken for m/s2.
GRAVITY_IN = {"g": 1.0, "mg": 1000.0, "cm/s2": 100 * STANDARD_GRAVITY_MPS2, "mm/s2": 1000 * STANDARD_GRAVITY_MPS2}
NEAR = 0.05  # relative: offsets of a reference are not larger
# Of a sensor in another unit: Livox-SDK/livox_ros_driver pull request 98 shows 0.88 at rest in a message for m/s2, and
# uzh-rpg/rpg_dvs_ros issue 58 shows 0.9.
NEAR_IN_UNIT = 0.15
NOT_FELT_MPS2 = 1.0  # largest mean of a reference that does not feel gravity: offsets of 0.1 g
GRAVITY_IN_G = 0.8  # or more, where a unit that nobody stated may be g
MEANS_OF = (1, 8, 64, 512)  # samples
FEWEST = 10  # means that tell how they scatter
STEADY = 0.2  # quartiles of their magnitudes, relative; 0.6 of noise around zero
SHORT = frozenset(names[0] for names in REFERENCES if len(names) == 1)  # names of this program, which state the unit
ROWS = 100_000  # spread over the file
ROWS_AT_ONCE = 1000  # of them


def unit_hint(length: float) -> str:
    """A hint if a vector of gravity with this length is in another unit than m/s2, otherwise ""."""
    unit = _unit(length)
    return f"; values of about {GRAVITY_IN[unit]:.4g} at rest are in {unit}" if unit else ""


def check_gravity(reference: ReferenceTable) -> None:
    """Refuse a tri-axial reference whose unit nobody stated and which feels gravity as in another unit, or as in none.

    Raises UnitError, with the unit where it is a known one.
    """
    if reference.channels != 3 or reference.unit_stated or reference.quantity != "acceleration":
        return
    length, usual = _mean_length(reference)
    if usual:
        return
    unit = _unit(length)
    raise UnitError(
        f"the mean has a magnitude of {length:.4g} m/s2, but gravity has 9.8"
        f"{unit_hint(length) or f' ({_in_g(length)}): another unit, or `sensor` and `reference` are exchanged'}",
        unit, place=reference.place, column=reference.column, value=length,
    )  # fmt: skip


def gravity_warnings(reference: ReferenceTable) -> list[str]:
    """A sentence where a reference that feels gravity reads what gravity cannot be, though its unit was stated."""
    if reference.quantity != "acceleration":
        return []
    length, usual = _mean_length(reference)
    if usual or (reference.channels == 1 and length <= STANDARD_GRAVITY_MPS2):
        return []
    return [
        f"the reference reads {_in_g(length)} where it feels gravity, 1 g: check its unit and its sensitivity, and "
        "whether sensor and reference are exchanged"
    ]


def unconfirmed_unit(reference: ReferenceTable, coupling: Coupling) -> list[str]:
    """A sentence where neither gravity in a reference nor anybody tells its unit. Columns a, v, d are in SI units."""
    if reference.unit_stated or (reference.channels == 1 and reference.column in SHORT) or measures_gravity(reference):
        return []
    taken = f"in {SI_NAMES[reference.quantity]}; state the unit after the names of its columns"
    if reference.channels == 1:
        return [f"nobody stated the unit of the reference: it is taken {taken}"]
    ac = "as AC-coupled, and " if coupling == "ac" else ""
    return [f"the reference feels no gravity, and nobody stated its unit: it is taken {ac}{taken}"]


def measures_gravity(reference: ReferenceTable) -> bool:
    """Whether a reference measures gravity, and so is DC-coupled: a tri-axial one of accelerations, unless its mean is
    small and no means over some samples have a steady magnitude. One that seems to be in another unit counts as one
    that does."""
    if reference.channels != 3 or reference.quantity != "acceleration":
        return False
    if not reference.unit_stated and not _mean_length(reference)[1]:
        return True
    rows = _some_rows(reference.x)
    if float(np.linalg.norm(rows.mean(axis=0))) >= NOT_FELT_MPS2:
        return True
    return any(length >= NOT_FELT_MPS2 and scatter < STEADY for length, scatter in _mean_lengths(rows))


def may_feel_gravity(sensor: SensorTable, reference: ReferenceTable) -> bool:
    """Whether the sensor's mean may be gravity: it is large, where outputs and reference are compared by how they move.
    An offset of half the supply is as large. Beside a reference whose unit nobody stated it may be gravity in g."""
    V, x = _some_rows(sensor.v), _some_rows(reference.x)
    moved = float(np.sqrt(np.var(V, axis=0).sum()))
    least = NOT_FELT_MPS2 if reference.unit_stated else GRAVITY_IN_G
    return float(np.linalg.norm(V.mean(axis=0)) * np.sqrt(np.var(x, axis=0).sum())) >= least * moved


def _some_rows(samples: Slices) -> Array:
    """Whole rows (n, C) of a table's samples, spread over it."""
    step = -(-len(samples) // ROWS)
    firsts = range(0, len(samples), ROWS_AT_ONCE * step)
    rows = np.concatenate([samples[first : first + ROWS_AT_ONCE * step : step] for first in firsts])
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def _mean_lengths(rows: Array) -> list[tuple[float, float]]:
    """The median magnitude of means over more and more samples, and the distance of its quartiles over it."""
    told = []
    for size in (size for size in MEANS_OF if FEWEST * size <= len(rows) or size == 1):
        means = rows[: len(rows) // size * size].reshape(-1, size, rows.shape[1]).mean(axis=1)
        low, middle, high = np.quantile(np.linalg.norm(means, axis=1), (0.25, 0.5, 0.75)).tolist()
        told.append((middle, (high - low) / max(middle, np.finfo(float).tiny)))
    return told


def _mean_length(reference: ReferenceTable) -> tuple[float, bool]:
    """The magnitude of the mean where it is steadiest, and whether it is a usual one over any number of samples.

    Means over more and more samples are tried: those of a few contain the motion, those of many how the reference was
    turned.
    """
    rows = _some_rows(reference.x)
    lengths, scatter = zip(*_mean_lengths(rows), strict=True)
    named = [k for k, length in enumerate(lengths) if _unit(length) and scatter[k] < STEADY]
    best = min(named or range(len(lengths)), key=lambda k: scatter[k])
    not_felt = float(np.linalg.norm(rows.mean(axis=0))) < NOT_FELT_MPS2
    return lengths[best], (not_felt or any(map(_usual, lengths))) and not named


def _usual(length: float) -> bool:
    """Whether this is the length of gravity in m/s2, or of the mean of a reference that does not feel it."""
    return length < NOT_FELT_MPS2 or math.isclose(length, STANDARD_GRAVITY_MPS2, rel_tol=NEAR)


def _in_g(length: float) -> str:
    return f"{length / STANDARD_GRAVITY_MPS2:.3g} g"


def _unit(length: float) -> str:
    """The unit in which gravity has about this length, the nearest of several; "" if there is none."""
    name, g = min(GRAVITY_IN.items(), key=lambda unit: abs(length / unit[1] - 1.0))
    return name if math.isclose(length, g, rel_tol=NEAR_IN_UNIT) else ""
