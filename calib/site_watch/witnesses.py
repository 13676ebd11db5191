"""What else than the structure says of a change: gravity (the mean of each output), the noise floor, the self-test.

All are asked at the date that the structure has told, so no date is sought. A change of the sensitivity of an axis
by s changes its mean by s times the mean, since gravity is always there; a turn changes the means as it changes any
acceleration. A witness that could not see a change of this size is silent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.model import Array
from calib.site_watch.together import DIRECTIONS

AGREES = 2.0  # standard uncertainties within which two sizes agree, and below which a size cannot be seen
LEAST_NOISE = 3.0  # standard uncertainties from which the noise floor has changed, at a date that others tell
# Relative standard uncertainty of the power of the supply with which a response grows, from part to part and axis to
# axis. Data sheets give typical values, or none; this one is assumed.
U_SUPPLY_POWER = 0.1
LEAST_U_RESPONSE = 1e-4  # of a change of the log of a response, however little it scatters
LEAST_U_MPS2 = 1e-5  # of a change of the mean, however steady it is: no output is read that exactly
TURNS = 3  # index in theta of the first turn


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """What one witness says of a change: `says` is agrees, contradicts or silent.

    `size`, `u`: the relative change (or angle in rad) that it tells by itself, of the noise that of its amplitude;
    NaN and inf where it tells none.
    """

    name: str
    says: str
    size: float = float("nan")
    u: float = float("inf")


def gravity(direction: int, size: float, u: float, mean: Array, step: Array, u_step: Array) -> Witness:
    """Gravity on a change of `size` ± `u` in DIRECTIONS[direction].

    `mean`, `step`, `u_step` (3,): the mean acceleration, how it changed at the date, and the standard uncertainty of
    this, in m/s².
    """
    theta = DIRECTIONS[direction]
    moved = theta[:TURNS] * mean + _turned(theta[TURNS:], mean)  # for a change of one unit
    weight = np.where(np.isfinite(u_step) & np.isfinite(moved), 1.0 / np.square(np.maximum(u_step, LEAST_U_MPS2)), 0.0)
    moved = np.where(weight > 0.0, moved, 0.0)
    information = float(np.sum(weight * moved**2))
    if information * size**2 < AGREES**2:
        return Witness("gravity", "silent")
    told = float(np.sum(weight * moved * np.where(weight > 0.0, step, 0.0))) / information
    u_told = information**-0.5
    alike = abs(told - size) <= AGREES * float(np.hypot(u_told, u))
    return Witness("gravity", "agrees" if alike else "contradicts", told, u_told)


def noise(direction: int, step: Array, u_step: Array) -> Witness:
    """The noise floor on a change in DIRECTIONS[direction]; `step`, `u_step` (3,): of the log amplitude at the date.

    Noise that changes with the sensitivity says that the sensor has changed, not the structure at it.
    """
    axes = np.flatnonzero(DIRECTIONS[direction][:TURNS])
    if not len(axes):
        return Witness("noise", "silent")
    z = np.abs(step[axes]) / u_step[axes]
    best = axes[int(np.argmax(z))]
    if not z.max() > LEAST_NOISE:
        return Witness("noise", "silent")
    factor = float(np.exp(step[best]))
    return Witness("noise", "agrees", factor - 1.0, factor * float(u_step[best]))


def supply_basis(u_supply: Array) -> Array:
    """Orthonormal rows (n, 3, 3) of each sensor: along what the supply does to the responses of x, y, z, and across it.

    `u_supply` (n, 3): standard uncertainties of the log responses by the supply, of one sign; where none is known, all
    axes alike.
    """
    known = np.isfinite(u_supply).all(axis=1) & (np.sum(u_supply, axis=1) > 0.0)
    along = np.where(known[:, None], u_supply, 1.0)
    across = np.broadcast_to(np.array([[1.0, 0.0], [-1.0, 1.0], [0.0, -1.0]]), (len(along), 3, 2))
    q, _ = np.linalg.qr(np.concatenate([along[:, :, None], across], axis=2))
    return np.asarray(np.swapaxes(q, 1, 2))


def self_test(direction: int, size: float, u: float, step: Array, u_step: Array, u_supply: Array) -> Witness:
    """The self-test on a change of `size` ± `u` in DIRECTIONS[direction].

    `step`, `u_step` (3,): how the log responses changed at the date, along the rows of `supply_basis`; `u_supply` (3,)
    as there. A change of one axis is seen across the supply however this has changed, and one of all three only beyond
    it. How much of a change of the sensitivity the response shows is not known of any part: it agrees where it has
    changed with the same sign at all, and tells its own size. It contradicts where it has not, and not by `size`.
    """
    theta = DIRECTIONS[direction][:TURNS]
    if not (theta.any() and np.isfinite(u_step).all() and np.isfinite(u_supply).all()):
        return Witness("self-test", "silent")
    basis = supply_basis(u_supply[None])[0]
    moved = basis @ theta
    variance = np.square(np.maximum(u_step, LEAST_U_RESPONSE)) + basis**2 @ np.square(U_SUPPLY_POWER * u_supply)
    variance[0] += np.sum(np.square(u_supply))
    information = float(np.sum(moved**2 / variance))
    if information * size**2 < AGREES**2:
        return Witness("self-test", "silent")
    told, u_told = float(np.sum(moved * step / variance)) / information, information**-0.5
    if told * np.sign(size) >= AGREES * u_told:
        return Witness("self-test", "agrees", told, u_told)
    other = abs(told - size) > AGREES * float(np.hypot(u_told, u))
    return Witness("self-test", "contradicts" if other else "silent", told, u_told)


def _turned(turn: Array, mean: Array) -> Array:
    """W a, with W as in calib.site_watch.together: a turn about x adds a_z to y and takes a_y from z."""
    changed = np.zeros(3)
    for w in range(3):
        changed[(w + 1) % 3] += turn[w] * mean[(w + 2) % 3]
        changed[(w + 2) % 3] -= turn[w] * mean[(w + 1) % 3]
    return changed
