"""Norm fit: S and Q from rests in unknown positions, without a reference. Only the magnitude of gravity is known.

At every rest the vector S^-1 (V - Q) has the length g (Eq. 8). A rotation of the frame does not change lengths, so the
frame can be chosen: S is upper triangular with a positive diagonal. Row z of S then has only S_zz: the z axis of the
frame is the direction to which output z responds. Row y has no S_yx: output y responds only to y and z (Mikov, Reginya
and Moschevikin, ICINS 2020, Eqs. 1-2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.distributions import coverage_factor
from calib.estimate.determined import DETERMINED_U
from calib.model import Array, Calibration, Window

UNKNOWNS = 9  # six elements of S, three of Q
UPPER = np.triu_indices(3)
PARAMETER = np.array([3 * int(i) + int(j) for i, j in zip(*UPPER, strict=True)] + [9, 10, 11])  # in calib.model order
MAX_STEPS = 50
ROUNDING = 1e-12  # of the scale: a smaller step is a rounding error
# Least singular value of the scaled problem relative to the largest. It is 1e-17 for rests in one plane, 0.01 to 0.14
# for ten random positions, and 0.1 to 0.4 for twenty-two.
RANK_TOLERANCE = 1e-3
RESIDUAL_LIMIT = 0.02  # of g; real rests leave 2e-4, a stretch that was no rest or a clipped axis leaves more


@dataclass(frozen=True, slots=True, eq=False)
class NormFit:
    """The result of a norm fit.

    `calibration` has an upper triangular S; the zeros below its diagonal are the choice of the frame and have no
    uncertainty. `coverage_factor` is k for 95.45 %. `residual_mps2` (W,) is g less the length found at each rest.
    `reasons` says why the fit is refused; empty if it is accepted.
    """

    calibration: Calibration
    coverage_factor: float
    residual_mps2: Array
    reasons: tuple[str, ...]


def norm_fit(windows: Sequence[Window], gravity_mps2: float, u_gravity_mps2: float = 0.0) -> NormFit:
    """Fit S and Q to the means of all used windows, each weighted by its number of samples.

    `gravity_mps2` is g and `u_gravity_mps2` its standard uncertainty, in m/s2. The scatter of the lengths about g gives
    the type A uncertainty; u(g) adds to that of S. Raises ValueError for fewer than ten rests, because nine rests
    leave no degree of freedom for the scatter.
    """
    used = [w for w in windows if w.used]
    if len(used) <= UNKNOWNS:
        raise ValueError(
            f"a norm fit needs at least {UNKNOWNS + 1} rests in different positions, {len(used)} were found: "
            "let the sensor rest for some seconds in more positions"
        )
    count = np.array([w.sums.count.sum() for w in used])
    means = np.array([w.sums.count @ w.sums.mean[:, -3:] / w.sums.count.sum() for w in used])
    x, residual, jacobian = _solve(means, np.sqrt(count / count.mean()), gravity_mps2)
    scale = np.linalg.norm(jacobian, axis=0)
    singular = np.linalg.svd(jacobian / scale, compute_uv=False)
    reasons = []
    if singular[-1] < RANK_TOLERANCE * singular[0]:
        rank = int((singular >= RANK_TOLERANCE * singular[0]).sum())
        reasons.append(
            f"rank {rank} of {UNKNOWNS}: the positions of the rests do not determine all parameters; "
            "add rests in other positions, with each axis up and down"
        )
    if np.abs(residual).max() > RESIDUAL_LIMIT * gravity_mps2:
        worst = int(np.argmax(np.abs(residual)))
        reasons.append(
            f"the rest at {used[worst].start_s:.6g} s differs from gravity by {residual[worst]:.3g} m/s2 "
            f"(limit {RESIDUAL_LIMIT * gravity_mps2:.3g} m/s2): the sensor moved there, or an axis was clipped"
        )
    freedom = len(used) - UNKNOWNS
    inverse = np.linalg.pinv(jacobian)
    variance = float(np.sum(count / count.mean() * residual**2)) / freedom
    along = np.where(np.arange(UNKNOWNS) < 6, x / gravity_mps2, 0.0)  # S is proportional to 1 / g
    covariance = variance * inverse @ inverse.T + u_gravity_mps2**2 * np.outer(along, along)
    return NormFit(_calibration(x, covariance, float(freedom)), coverage_factor(freedom), residual, tuple(reasons))


def _solve(means: Array, weight: Array, gravity_mps2: float) -> tuple[Array, Array, Array]:
    """[upper triangle of S, Q] (9,), residuals (W,) and weighted Jacobian (W, 9) by Gauss-Newton.

    It starts with equal main sensitivities and no transverse ones.
    """
    centre = 0.5 * (means.max(axis=0) + means.min(axis=0))
    size = float(np.sqrt(np.mean(np.sum((means - centre) ** 2, axis=1)))) / gravity_mps2
    x = np.concatenate([size * np.eye(3)[UPPER], centre])
    for _ in range(MAX_STEPS):
        residual, jacobian = _lengths(x, means, gravity_mps2)
        step = np.linalg.lstsq(jacobian * weight[:, None], residual * weight, rcond=None)[0]
        x = x + step
        if np.abs(step).max() < ROUNDING * size * gravity_mps2:
            break
    residual, jacobian = _lengths(x, means, gravity_mps2)
    return x, residual, jacobian * weight[:, None]


def _lengths(x: Array, means: Array, gravity_mps2: float) -> tuple[Array, Array]:
    """g - |S^-1 (V - Q)| (W,), and the derivative of the length with respect to the unknowns (W, 9)."""
    S = np.zeros((3, 3))
    S[UPPER] = x[:6]
    inverse = np.linalg.inv(S)
    a = (means - x[6:]) @ inverse.T
    length = np.linalg.norm(a, axis=1)
    back = a / length[:, None] @ inverse
    return gravity_mps2 - length, -np.hstack([back[:, UPPER[0]] * a[:, UPPER[1]], back])


def _calibration(x: Array, covariance: Array, freedom: float) -> Calibration:
    values, full = np.zeros(12), np.zeros((12, 12))
    values[PARAMETER] = x
    full[np.ix_(PARAMETER, PARAMETER)] = covariance
    determined = np.sqrt(np.diag(full)) <= DETERMINED_U * np.abs(values[[0, 4, 8]]).max()
    values = np.where(determined, values, np.nan)
    full = np.where(np.outer(determined, determined), full, np.nan)
    return Calibration(values[:9].reshape(3, 3), values[9:], full, determined, freedom, "norm fit (frame free)")
