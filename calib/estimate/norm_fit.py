"""Norm fit: rests in any positions, no reference; that |a| is gravity's magnitude is all that is known.

S^-1 (V - Q) has length g at every rest (Eq. 8). A turn of the frame leaves lengths as they are, so S is stated as upper
triangular with a positive diagonal: z of the frame is the z axis' own direction of sensitivity, x lies in the plane of
x and y (Mikov, Reginya and Moschevikin, ICINS 2020, Eqs. 1-2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.distributions import coverage_factor
from calib.model import Array, Calibration, Window

UNKNOWNS = 9  # six of S, three of Q
UPPER = np.triu_indices(3)
PARAMETER = np.array([3 * int(i) + int(j) for i, j in zip(*UPPER, strict=True)] + [9, 10, 11])  # in calib.model order
MAX_STEPS = 50
ROUNDING = 1e-12  # of the scale: a step below it is rounding
# Singular value of the scaled problem, over the largest, below which the rests leave a parameter open: rests in one
# plane stand at 1e-17, ten at random between 0.01 and 0.14, twenty-two between 0.1 and 0.4.
RANK_TOLERANCE = 1e-3
DETERMINED_U = 0.1  # of the largest main sensitivity; a parameter known worse is not stated (contract)
RESIDUAL_LIMIT = 0.02  # of g; hand-placed rests leave 2e-4, a rest that was none or a clipped axis leaves more


@dataclass(frozen=True, slots=True, eq=False)
class NormFit:
    """S upper triangular (zeros below have no uncertainty: they are the choice of the frame), Q, and what rests on.

    `residual_mps2` (W,): g less the length found at each rest.
    """

    calibration: Calibration
    coverage_factor: float
    residual_mps2: Array
    reasons: tuple[str, ...]


def norm_fit(windows: Sequence[Window], gravity_mps2: float, u_gravity_mps2: float = 0.0) -> NormFit:
    """Fit the means of all used windows, each weighted by its number of samples.

    The scatter of the lengths about g, over the rests left over, is the type A uncertainty; u(g) adds to S. Raises
    ValueError with fewer than ten rests: nine unknowns leave no scatter to see with nine.
    """
    used = [w for w in windows if w.used]
    if len(used) <= UNKNOWNS:
        raise ValueError(f"a norm fit needs {UNKNOWNS + 1} rests or more in different positions, found {len(used)}")
    count = np.array([w.sums.count.sum() for w in used])
    means = np.array([w.sums.count @ w.sums.mean[:, -3:] / w.sums.count.sum() for w in used])
    x, residual, jacobian = _solve(means, np.sqrt(count / count.mean()), gravity_mps2)
    scale = np.linalg.norm(jacobian, axis=0)
    singular = np.linalg.svd(jacobian / scale, compute_uv=False)
    reasons = []
    if singular[-1] < RANK_TOLERANCE * singular[0]:
        rank = int((singular >= RANK_TOLERANCE * singular[0]).sum())
        reasons.append(f"rank {rank} of {UNKNOWNS}: the rests' positions leave parameters open")
    if np.abs(residual).max() > RESIDUAL_LIMIT * gravity_mps2:
        worst = int(np.argmax(np.abs(residual)))
        reasons.append(
            f"the rest at {used[worst].start_s:.6g} s is {residual[worst]:.3g} m/s2 off gravity, "
            f"limit {RESIDUAL_LIMIT * gravity_mps2:.3g} m/s2"
        )
    freedom = len(used) - UNKNOWNS
    inverse = np.linalg.pinv(jacobian)
    variance = float(np.sum(count / count.mean() * residual**2)) / freedom
    along = np.where(np.arange(UNKNOWNS) < 6, x / gravity_mps2, 0.0)  # S goes as 1 / g
    covariance = variance * inverse @ inverse.T + u_gravity_mps2**2 * np.outer(along, along)
    return NormFit(_calibration(x, covariance, float(freedom)), coverage_factor(freedom), residual, tuple(reasons))


def _solve(means: Array, weight: Array, gravity_mps2: float) -> tuple[Array, Array, Array]:
    """[S upper, Q] (9,), residuals (W,) and weighted Jacobian (W, 9), by Gauss-Newton from a sphere."""
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
    """g - |S^-1 (V - Q)| (W,) and the derivative of the length (W, 9)."""
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
