"""Norm fit: S and Q from rests in unknown positions, without a reference. Only the magnitude of gravity is known.

At every rest the vector S^-1 (V - Q) has the length g (Eq. 8). A rotation of the frame does not change lengths, so the
frame can be chosen: S is upper triangular with a positive diagonal. Row z of S then has only S_zz: the z axis of the
frame is the direction to which output z responds. Row y has no S_yx: output y responds only to y and z (Mikov, Reginya
and Moschevikin, ICINS 2020, Eqs. 1-2).

Q drifts while a sensor warms up and is turned: a random walk, beside the independent scatter of each rest. Nobody
states how large it is, so the fit is made for many ratios of the two and averaged with the likelihood of each.
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
STEPS = 64  # of the random walk of Q over all rests
# Variance of that walk over the whole time, in that of one rest. From nothing to so much that only the walk is left.
WALKS = np.append(0.0, np.geomspace(0.1, 1e3, 13))
TURNS = 3  # of the linearisation at the average; the second changes nothing that matters
HOW_TO_TELL = (
    "state the position of each rest in `poses` (start_s,stop_s,gx,gy,gz), of which six suffice, or add rests on edges "
    "of all three axes, where two axes share gravity"
)
RESIDUAL_LIMIT = 0.02  # of g; real rests leave 2e-4, a stretch that was no rest or a clipped axis leaves more


@dataclass(frozen=True, slots=True, eq=False)
class NormFit:
    """The result of a norm fit.

    `calibration` has an upper triangular S; the zeros below its diagonal are the choice of the frame and have no
    uncertainty. Q is that in the middle of the rests; its u contains the walk from there to the first or last of them.
    `coverage_factor` is k for 95.45 %. `residual_mps2` (W,) is g less the length found at each rest. `drift_mps2` is
    the standard deviation by which Q walks from the first rest to the last. `reasons` says why the fit is refused;
    empty if it is accepted.
    """

    calibration: Calibration
    coverage_factor: float
    residual_mps2: Array
    drift_mps2: float
    reasons: tuple[str, ...]


def norm_fit(windows: Sequence[Window], gravity_mps2: float, u_gravity_mps2: float = 0.0) -> NormFit:
    """Fit S and Q to the means of all used windows, each weighted by its number of samples and by when it was.

    `gravity_mps2` is g and `u_gravity_mps2` its standard uncertainty, in m/s2. The scatter of the lengths about g gives
    the type A uncertainty, and the drift of Q; u(g) adds to that of S. Raises ValueError for fewer than ten rests,
    because nine rests leave no degree of freedom for the scatter.
    """
    used = [w for w in windows if w.used]
    if len(used) <= UNKNOWNS:
        raise ValueError(
            f"the positions of the rests are not stated, so that {UNKNOWNS + 1} rests are needed, and {len(used)} were "
            f"found; {HOW_TO_TELL}"
        )
    count = np.array([w.sums.count.sum() for w in used])
    means = np.array([w.sums.count @ w.sums.mean[:, -3:] / w.sums.count.sum() for w in used])
    weight = np.sqrt(count / count.mean())
    x, covariance, walked = _averaged(means, weight, np.array([w.start_s + w.stop_s for w in used]), gravity_mps2)
    residual, jacobian = _lengths(x, means, gravity_mps2)
    jacobian *= weight[:, None]
    scale = np.linalg.norm(jacobian, axis=0)
    singular = np.linalg.svd(jacobian / scale, compute_uv=False)
    reasons = []
    if singular[-1] < RANK_TOLERANCE * singular[0]:
        reasons.append(
            f"the positions of the {len(used)} rests do not determine all {UNKNOWNS} parameters: "
            f"those on the faces alone, or in one plane, leave some open; {HOW_TO_TELL}"
        )
    if np.abs(residual).max() > RESIDUAL_LIMIT * gravity_mps2:
        worst = int(np.argmax(np.abs(residual)))
        reasons.append(
            f"the rest at {used[worst].start_s:.6g} s differs from gravity by {residual[worst]:.3g} m/s2 "
            f"(limit {RESIDUAL_LIMIT * gravity_mps2:.3g} m/s2): the sensor moved there, or an axis was clipped"
        )
    freedom = _freedom(len(used))
    along = np.where(np.arange(UNKNOWNS) < 6, x / gravity_mps2, 0.0)  # S is proportional to 1 / g
    covariance[range(6, 9), range(6, 9)] += 0.5 * walked  # the middle is half the time away from both ends
    covariance += u_gravity_mps2**2 * np.outer(along, along)
    drift_mps2 = float(np.sqrt(walked / np.mean(x[[0, 3, 5]] ** 2)))
    found = _calibration(x, covariance, float(freedom))
    return NormFit(found, coverage_factor(freedom), residual, drift_mps2, tuple(reasons))


def _averaged(means: Array, weight: Array, time_s: Array, gravity_mps2: float) -> tuple[Array, Array, float]:
    """The unknowns (9,), their covariance (9, 9), and the variance of the walk of Q over all rests, in output unit
    squared: averages over WALKS by restricted likelihood, each ratio as likely beforehand."""
    x = _solve(means, weight, gravity_mps2)
    span = max(float(np.ptp(time_s)), np.finfo(float).tiny)
    walk = walk_steps((time_s - 0.5 * (time_s.max() + time_s.min())) / span)
    for _ in range(TURNS):
        residual, jacobian = _lengths(x, means, gravity_mps2)
        by_offset = jacobian[:, 6:]
        size = float(np.mean(np.sum(by_offset**2, axis=1)))
        moved = (by_offset[:, :, None] * walk[:, None, :]).reshape(len(means), -1) / np.sqrt(size)
        rows = np.column_stack([jacobian, residual]) * weight[:, None]
        steps, inverse, variance, likelihood = _by_ratio(rows, moved * weight[:, None])
        share = np.exp(likelihood - likelihood.max())
        share /= share.sum()
        mean = share @ steps
        apart = steps - mean
        covariance = np.tensordot(share * variance, inverse, 1) + (share[:, None] * apart).T @ apart
        x = x + mean
    return x, covariance, float(share @ (WALKS * variance)) / size


def _by_ratio(rows: Array, moved: Array) -> tuple[Array, Array, Array, Array]:
    """For each ratio in WALKS: the step (9,), its covariance (9, 9) for a unit variance, that variance, and the
    logarithm of the restricted likelihood.

    `rows` (W, 10): Jacobian and residual; `moved` (W, R): what a unit step of the walk does to them.
    """
    ways, root, _ = np.linalg.svd(moved, full_matrices=False)
    square = WALKS[:, None] * root**2
    along = ways.T @ rows
    normal = rows.T @ rows - np.einsum("kr,ri,rj->kij", square / (1.0 + square), along, along)
    inverse = np.linalg.pinv(normal[:, :9, :9], hermitian=True)
    steps = (inverse @ normal[:, :9, 9:])[..., 0]
    left = normal[:, 9, 9] - np.sum(normal[:, 9, :9] * steps, axis=1)
    left = np.maximum(left, max(np.finfo(float).eps * normal[0, 9, 9], np.finfo(float).tiny))
    # The determinant without directions in which nothing is known: they are the same for every ratio.
    determinant = np.log1p(square).sum(axis=1) - np.linalg.slogdet(inverse + np.eye(9) * np.finfo(float).eps)[1]
    likelihood = -0.5 * ((len(rows) - UNKNOWNS) * np.log(left) + determinant)
    return steps, inverse, left / _freedom(len(rows)), likelihood


def _freedom(rests: int) -> int:
    """Degrees of freedom: of the rests, less the unknowns and the ratio of the walk."""
    return max(rests - UNKNOWNS - 1, 1)


def walk_steps(part: Array) -> Array:
    """(W, STEPS) how far a walk in STEPS independent steps, 0 in the middle, has gone at these parts of the time."""
    edges = np.linspace(-0.5, 0.5, STEPS + 1)
    gone = np.clip(part[:, None], edges[:-1], edges[1:]) - np.clip(0.0, edges[:-1], edges[1:])
    return np.asarray(gone * np.sqrt(STEPS))


def _solve(means: Array, weight: Array, gravity_mps2: float) -> Array:
    """[upper triangle of S, Q] (9,) by Gauss-Newton for a Q that does not drift.

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
    return x


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
    # Where the positions leave a direction free, rounding can make a variance negative: nothing is known there.
    variance = np.where(np.diag(full) < 0.0, np.inf, np.diag(full))
    determined = np.sqrt(variance) <= DETERMINED_U * np.abs(values[[0, 4, 8]]).max()
    values = np.where(determined, values, np.nan)
    full = np.where(np.outer(determined, determined), full, np.nan)
    return Calibration(values[:9].reshape(3, 3), values[9:], full, determined, freedom, "norm fit (frame free)")
