"""Weighted least squares of the window equations with priors, by Gauss-Newton on stacked factors (never squared)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.estimate.equations import Equations
from calib.estimate.nuisances import Priors
from calib.model import Array

Flags = NDArray[np.bool_]
MAX_STEPS = 30
MAX_HALVINGS = 8
CONVERGED = 1e-3  # of a standard uncertainty: the step after it, still taken, is smaller by about as much again
ROUNDING = 1e-13  # of the scale: a step below it is rounding
# What nothing is known of beforehand is held by this many times its scale: weak enough to move what is known to 1 % by
# 1e-12 of it, strong enough that a direction nobody excited leaves nothing singular.
UNBOUNDED = 1e4
OFFSET_SCALE_MPS2 = 10.0
PARAMETER_ROWS = [[3 * i, 3 * i + 1, 3 * i + 2, 9 + i] for i in range(3)]  # S_ix, S_iy, S_iz, Q_i


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where it ended: x = [S row by row, Q, nuisances] (N,), and the whitened residuals (rows,) there.

    `half` (N, N): half half' = H^-1. `jacobian` (rows, N) is J half, in coordinates in which H is the identity: only
    there can sums over a direction that nobody excited be taken without losing all digits. `prior_mean` (N,),
    `prior_precision` (N, N); `bounded` (12,) tells which of S, Q had a prior of their own.
    """

    equations: Equations
    x: Array
    half: Array
    residual: Array
    jacobian: Array
    prior_mean: Array
    prior_precision: Array
    bounded: Flags

    @property
    def chi2(self) -> float:
        """Sum of squares of the whitened residuals and of what moved against its prior."""
        pull = self.x - self.prior_mean
        return float(self.residual @ self.residual + pull @ self.prior_precision @ pull)

    @property
    def leverage(self) -> Array:
        """(rows,) how much of each row's own scatter the fit takes up, 0 to 1."""
        return np.asarray(np.einsum("rn,rn->r", self.jacobian, self.jacobian))


def solve(equations: Equations, priors: Priors) -> Solution:
    """Minimise chi2 from the priors' means; the first step alone solves S and Q where every nuisance is fixed."""
    scale, mean, precision, bounded = _priors(equations, priors)
    root: Array = np.asarray(np.linalg.cholesky(precision * np.outer(scale, scale)).T, dtype=np.float64)
    x = mean.copy()
    residual, jacobian = _stacked(equations, x, mean, scale, root)
    for _ in range(MAX_STEPS):
        half, step = _step(jacobian, residual)
        if np.all(np.abs(step) < np.maximum(CONVERGED * np.linalg.norm(half, axis=1), ROUNDING)):
            break
        x, residual, jacobian = _shortened(equations, x, step, mean, scale, root, float(residual @ residual))
    x = x + step * scale
    # Where the noise is small the equations bend by more than that within the last step: half is taken at its end.
    residual, jacobian = _stacked(equations, x, mean, scale, root)
    half, _ = _step(jacobian, residual)
    rows = len(residual) - len(x)  # the others are the priors'
    return Solution(
        equations, x, half * scale[:, None], residual[:rows], jacobian[:rows] @ half, mean, precision, bounded
    )


def _step(jacobian: Array, residual: Array) -> tuple[Array, Array]:
    """half with half half' = (J'J)^-1, and the step (N,), of scaled unknowns."""
    # The factor of [J, r] holds that of J and Q'r: Q itself is never needed.
    n = jacobian.shape[1]
    factor = np.asarray(np.linalg.qr(np.column_stack([jacobian, residual]), mode="r"), dtype=np.float64)
    half = np.asarray(np.linalg.inv(factor[:n, :n]), dtype=np.float64)
    return half, half @ factor[:n, n]


def slope_residuals(solution: Solution) -> tuple[Array, Array]:
    """Whitened residuals (B, 6M) of the slopes and their rows (B, 6M, N) of J half."""
    residual, _ = solution.equations.split(solution.residual)
    rows, _ = solution.equations.split(solution.jacobian)
    return residual.reshape(len(residual), -1), rows.reshape(len(rows), -1, rows.shape[-1])


def _stacked(equations: Equations, x: Array, mean: Array, scale: Array, root: Array) -> tuple[Array, Array]:
    """Residuals and scaled Jacobian of the window equations and of the priors below them."""
    residual, jacobian = equations.at(x).stacked()
    return np.concatenate([residual, root @ ((mean - x) / scale)]), np.vstack([jacobian * scale, root])


def _shortened(
    equations: Equations, x: Array, step: Array, mean: Array, scale: Array, root: Array, before: float
) -> tuple[Array, Array, Array]:
    """The full step, or the first halving of it that does not make chi2 larger; with residuals and Jacobian there."""
    for halving in range(MAX_HALVINGS):
        tried = x + step * scale * 0.5**halving
        residual, jacobian = _stacked(equations, tried, mean, scale, root)
        if float(residual @ residual) <= before * (1.0 + ROUNDING):
            break
    return tried, residual, jacobian


def _priors(equations: Equations, priors: Priors) -> tuple[Array, Array, Array, Flags]:
    """Scale (N,), mean (N,), precision (N, N) of all unknowns, and which of S, Q (12,) are bounded by a prior."""
    nuisances, s = equations.nuisances, equations.output_per_mps2
    scale = np.concatenate([np.full(9, s), np.full(3, OFFSET_SCALE_MPS2 * s), nuisances.uncertainty])
    mean = np.concatenate([np.zeros(12), [t.expected - t.applied for t in nuisances.terms]])
    precision = np.diag(1.0 / scale**2)
    precision[range(12), range(12)] /= UNBOUNDED**2
    bounded = np.zeros(12, dtype=bool)
    if priors.parameters is not None and priors.covariance is not None:
        bounded = np.isfinite(np.diag(priors.covariance)) & np.isfinite(priors.parameters)
        known = np.flatnonzero(bounded)
        mean[known] = priors.parameters[known]
        precision[np.ix_(known, known)] = np.linalg.inv(priors.covariance[np.ix_(known, known)])
    if not bounded[:9].all():
        # What nobody excited is held at its scale: nuisances times a wandering column would else explain noise.
        for way in equations.unseen * np.array([1.0, 1.0, 1.0, 1.0 / OFFSET_SCALE_MPS2]):
            for row in PARAMETER_ROWS:
                held = way / np.linalg.norm(way) / scale[row]
                precision[np.ix_(row, row)] += np.outer(held, held)
    return scale, mean, precision, bounded
