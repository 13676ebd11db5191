"""Weighted least squares of the window equations with priors, by Gauss-Newton on stacked factors (never squared)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.equations import Equations
from calib.model import Array
from calib.nuisances import Priors

Flags = NDArray[np.bool_]
MAX_STEPS = 30
CONVERGED = 1e-6  # of a standard uncertainty: a step below it changes nothing that is stated
ROUNDING = 1e-13  # of the scale: a step below it is rounding
# What nothing is known of beforehand is held by this many times its scale: weak enough to move what is known to 1 % by
# 1e-12 of it, strong enough that a direction nobody excited leaves nothing singular.
UNBOUNDED = 1e4
OFFSET_SCALE_MPS2 = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where it ended: x = [S row by row, Q, nuisances] (N,), H^-1 (N, N), whitened residuals and Jacobian there.

    `prior_mean` (N,), `prior_precision` (N, N); `bounded` (12,) tells which of S, Q had a prior of their own.
    """

    equations: Equations
    x: Array
    inverse: Array
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
        return np.asarray(np.einsum("rn,rn->r", self.jacobian @ self.inverse, self.jacobian))


def solve(equations: Equations, priors: Priors) -> Solution:
    """Minimise chi2 from the priors' means; the first step alone solves S and Q where every nuisance is fixed."""
    scale, mean, precision, bounded = _priors(equations, priors)
    root = np.linalg.cholesky(precision * np.outer(scale, scale)).T
    x = mean.copy()
    for _ in range(MAX_STEPS):
        residual, jacobian = equations.at(x).stacked()
        q, r = np.linalg.qr(np.vstack([jacobian * scale, root]))
        step = np.linalg.solve(r, q.T @ np.concatenate([residual, root @ ((mean - x) / scale)]))
        x = x + step * scale
        uncertainty = np.linalg.norm(np.linalg.inv(r), axis=1)
        if np.all(np.abs(step) < np.maximum(CONVERGED * uncertainty, ROUNDING)):
            break
    residual, jacobian = equations.at(x).stacked()
    half = np.linalg.inv(r) * scale[:, None]
    return Solution(equations, x, half @ half.T, residual, jacobian, mean, precision, bounded)


def _priors(equations: Equations, priors: Priors) -> tuple[Array, Array, Array, Flags]:
    """Scale (N,), mean (N,), precision (N, N) of all unknowns, and which of S, Q (12,) are bounded by a prior."""
    nuisances, s = equations.nuisances, equations.output_per_mps2
    scale = np.concatenate([np.full(9, s), np.full(3, OFFSET_SCALE_MPS2 * s), nuisances.uncertainty])
    mean = np.concatenate([np.zeros(12), [-t.applied for t in nuisances.terms]])
    precision = np.diag(1.0 / scale**2)
    precision[range(12), range(12)] /= UNBOUNDED**2
    bounded = np.zeros(12, dtype=bool)
    if priors.parameters is not None and priors.covariance is not None:
        bounded = np.isfinite(np.diag(priors.covariance)) & np.isfinite(priors.parameters)
        known = np.flatnonzero(bounded)
        mean[known] = priors.parameters[known]
        precision[np.ix_(known, known)] = np.linalg.inv(priors.covariance[np.ix_(known, known)])
    return scale, mean, precision, bounded
