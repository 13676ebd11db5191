"""What the windows of one sensor beside one reference tell of both, as rows for the adjustment of a site.

The windows are adjusted as everywhere (calib.adjustment.adjustment). What belongs to this meeting alone is
marginalised: lag, response, angles, offsets. S and Q stay, and what other links share: the sensitivity of the
reference, and gravity.
The priors of what stays are subtracted, because calib.site_adjustment.site states them once for the whole site:

    information = C^-1 - P^-1        information vector = C^-1 x - P^-1 x0

Here x and C are the adjusted values and their covariance; x0 and P are the priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.adjustment.adjustment import Adjustment, adjust
from calib.estimate.nuisances import Applied, Priors
from calib.estimate.quantities import GRAVITY, REFERENCE
from calib.model import Array, Window
from calib.site_adjustment.offset_drift import drift_of

# Standard uncertainties where nothing is known, relative to the scale of the sensor. They are subtracted again.
WIDE = 10.0
WIDE_OFFSET_MPS2 = 1e3
LEAST_TOLD = 1e-6  # part of the prior's variance; where the data reduce it by less, that is a rounding error
ROUNDING = 1e-15  # of the same
GRAVITY_NAME = "gravity"
PARAMETER = {"reference": 0, "reference_x": 0, "reference_y": 4, "reference_z": 8}  # in calib.model.PARAMETERS


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """One sensor beside one reference.

    `rows` (k, n) times the n unknowns of the link are `told` (k,), with the identity as covariance. The unknowns are S
    row by row, Q, and `shared`: names of gravity and numbers of the reference's parameters, as (device, parameter).
    `rotation` (3, 3), with a = R a_ref, is given if the reference measures gravity in three axes. S and Q are then
    those that the sensor seems to have beside this reference, because its rotation, known to `u_rotation_rad`, and each
    of the reference's 12 parameters act on them (calib.site_adjustment.site); `shared` is empty. `mean` (12,): S and Q
    by this link alone; `degrees_of_freedom` of their type A part.
    """

    sensor: str
    reference: str
    rows: Array
    told: Array
    shared: tuple[tuple[str, int], ...]
    rotation: Array | None
    u_rotation_rad: float
    mean: Array
    degrees_of_freedom: float


def link(
    sensor: str,
    reference: str,
    windows: Sequence[Window],
    priors: Priors,
    applied: Applied | None = None,
) -> Link:
    """Adjust the used windows of a sensor beside a reference; "" is no reference, but rests under stated gravity.

    `priors`: those of the nuisances, and what is known of S. `applied`: what the front end took out of the data. Raises
    ValueError where no window is used.
    """
    used = [w for w in windows if w.used]
    if not used:
        raise ValueError("no window is used")
    rotation = _rotation(used)
    of_site = {"reference_drift": 0.0} | ({} if rotation is None else {"reference": 0.0, "rotation_rad": 0.0})
    here = priors.with_values(of_site)
    mean, u = _point(used, here, applied)
    variance = np.append(u[:9] ** 2, np.full(3, np.inf))
    known = replace(here, parameters=mean, covariance=np.diag(variance))
    found = adjust(used, known, applied)
    covariance = found.covariance
    if (drift := drift_of(found, used)) is not None:
        found = adjust(drift.removed_from(used), known, applied)
        covariance = found.covariance + drift.covariance
    rows, told, shared = _information(found, covariance, mean, u, reference)
    return Link(
        sensor, reference, rows, told, shared, rotation, priors.rotation_rad,
        found.mean[:12].copy(), found.calibration.degrees_of_freedom,
    )  # fmt: skip


def _rotation(used: Sequence[Window]) -> Array | None:
    """R if all windows are beside a tri-axial reference that measures gravity itself, in one pose; else None."""
    first, poses = used[0].pose.direction, {id(w.pose): w.pose for w in used}.values()
    alike = all(np.array_equal(pose.direction, first) and not np.any(pose.gravity_mps2) for pose in poses)
    return first if first.shape == (3, 3) and alike else None


def _point(used: Sequence[Window], priors: Priors, applied: Applied | None) -> tuple[Array, Array]:
    """Mean and standard uncertainty (12,) of S and Q with which the link is adjusted. They are subtracted again."""
    mean, u = np.zeros(12), np.full(12, np.inf)
    if priors.parameters is not None and priors.covariance is not None:
        mean, u = np.nan_to_num(priors.parameters), np.sqrt(np.diag(priors.covariance))
    if not np.isfinite(u[:9]).all():
        first = adjust(used, priors, applied)
        mean = np.where(np.isfinite(u), mean, first.mean[:12])
    scale = float(np.sqrt(np.mean(mean[[0, 4, 8]] ** 2)))
    u = np.where(np.isfinite(u), u, WIDE * scale)
    return np.append(mean[:9], np.zeros(3)), np.append(u[:9], np.full(3, WIDE_OFFSET_MPS2 * scale))


def _information(
    found: Adjustment, covariance: Array, mean: Array, u: Array, reference: str
) -> tuple[Array, Array, tuple[tuple[str, int], ...]]:
    """Rows, what they are told to be, and the shared unknowns; see Link. `mean`, `u` (12,) are subtracted."""
    kept = [j for j, n in enumerate(found.nuisances) if n.kind in (REFERENCE, GRAVITY)]
    names = [found.nuisances[j].name for j in kept]
    shared = [(GRAVITY_NAME, 0) if n not in PARAMETER else (reference, PARAMETER[n]) for n in names]
    index = [*range(12), *(12 + j for j in kept)]
    u = np.append(u, [found.nuisances[j].prior_uncertainty for j in kept])
    mean = np.append(mean, np.zeros(len(kept)))
    left, ways = np.linalg.eigh(covariance[np.ix_(index, index)] / np.outer(u, u))
    told = left < 1.0 - LEAST_TOLD
    left, ways = np.maximum(left[told], ROUNDING), ways[:, told]
    weight = np.sqrt(1.0 / left - 1.0)
    rows = (ways * weight).T / u
    moved = ways.T @ ((found.mean[index] - mean) / u)
    return rows, rows @ mean + moved / left / weight, tuple(shared)
