"""Weighted least squares of the window equations with priors: Gauss-Newton by QR factors, without normal equations."""

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
CONVERGED = 1e-3  # of a standard uncertainty. The step is still taken; the one after it would be 1000 times smaller
ROUNDING = 1e-13  # of the scale: a smaller step is a rounding error
# Standard uncertainty, relative to its scale, of a parameter without a prior. It is so large that it changes a
# parameter known to 1 % by 1e-12 only, and small enough that a direction without excitation is not singular.
UNBOUNDED = 1e4
OFFSET_SCALE_MPS2 = 10.0  # scale of Q
WIDE = 1e8  # ratio of the eigenvalues of a covariance, from which its inverse by elimination has too few digits
PARAMETER_ROWS = [[3 * i, 3 * i + 1, 3 * i + 2, 9 + i] for i in range(3)]  # S_ix, S_iy, S_iz, Q_i


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The solution x = [S row by row, Q, nuisances] (N,), and the whitened residuals (rows,) there.

    H = J'J with the rows of the windows and of the priors. `half` (N, N): half half' = H^-1. `jacobian` (rows, N) is
    J half, for the rows of the windows: in these coordinates H is the identity, so that sums over a direction without
    excitation do not lose all digits. `prior_mean` (N,) and `prior_precision` (N, N) are the priors; `bounded` (12,) is
    true for each parameter of S and Q that had a prior.
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
        """Sum of squares of the whitened residuals and of the deviations from the priors."""
        pull = self.x - self.prior_mean
        return float(self.residual @ self.residual + pull @ self.prior_precision @ pull)

    @property
    def leverage(self) -> Array:
        """(rows,) leverage of each row, 0 to 1: the part of its own scatter that the fit absorbs."""
        return np.asarray(np.einsum("rn,rn->r", self.jacobian, self.jacobian))


def solve(equations: Equations, priors: Priors) -> Solution:
    """Minimise chi2, starting at the priors' means, and for what the data alone determine (lag, response) at what the
    front end took out. If every nuisance is fixed, the first step is the solution."""
    scale, mean, precision, bounded = _priors(equations, priors)
    root: Array = np.asarray(np.linalg.cholesky(precision * np.outer(scale, scale)).T, dtype=np.float64)
    x = mean.copy()
    x[12:][[not term.kind.stated for term in equations.nuisances.terms]] = 0.0
    residual, jacobian = _stacked(equations, x, mean, scale, root)
    for _ in range(MAX_STEPS):
        half, step = _step(jacobian, residual)
        if np.all(np.abs(step) < np.maximum(CONVERGED * np.linalg.norm(half, axis=1), ROUNDING)):
            break
        x, residual, jacobian = _shortened(equations, x, step, mean, scale, root, float(residual @ residual))
    x = x + step * scale
    # If the noise is small, the equations are not linear enough within the last step: `half` is computed at its end.
    residual, jacobian = _stacked(equations, x, mean, scale, root)
    half, _ = _step(jacobian, residual)
    rows = len(residual) - len(x)  # the rows behind these belong to the priors
    return Solution(
        equations, x, half * scale[:, None], residual[:rows], jacobian[:rows] @ half, mean, precision, bounded
    )


def _step(jacobian: Array, residual: Array) -> tuple[Array, Array]:
    """`half` with half half' = (J'J)^-1, and the step (N,), both for scaled unknowns."""
    # The R factor of [J, r] contains that of J, and Q'r: Q itself is not needed.
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
    """Residuals and scaled Jacobian: the rows of the window equations first, then those of the priors."""
    residual, jacobian = equations.at(x).stacked()
    return np.concatenate([residual, root @ ((mean - x) / scale)]), np.vstack([jacobian * scale, root])


def _shortened(
    equations: Equations, x: Array, step: Array, mean: Array, scale: Array, root: Array, before: float
) -> tuple[Array, Array, Array]:
    """x after the full step, or after the first halved step that does not increase chi2; its residuals and Jacobian."""
    for halving in range(MAX_HALVINGS):
        tried = x + step * scale * 0.5**halving
        residual, jacobian = _stacked(equations, tried, mean, scale, root)
        if float(residual @ residual) <= before * (1.0 + ROUNDING):
            break
    return tried, residual, jacobian


def _priors(equations: Equations, priors: Priors) -> tuple[Array, Array, Array, Flags]:
    """Scale (N,), mean (N,) and precision (N, N) of all unknowns, and flags (12,) of S and Q that have a prior."""
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
        precision[np.ix_(known, known)] = _inverse(priors.covariance[np.ix_(known, known)])
    if not bounded[:9].all():
        # A column of S that was not excited is held at its scale. If it were free, it could take large values, and a
        # nuisance multiplied by it would then explain noise.
        mean[:9] += np.where(bounded[:9], 0.0, equations.likely.ravel())
        for way in equations.unseen * np.array([1.0, 1.0, 1.0, 1.0 / OFFSET_SCALE_MPS2]):
            for row in PARAMETER_ROWS:
                held = way / np.linalg.norm(way) / scale[row]
                precision[np.ix_(row, row)] += np.outer(held, held)
    return scale, mean, precision, bounded


def _inverse(covariance: Array) -> Array:
    """The inverse (n, n) of a covariance (n, n), positive definite also where some combinations of the parameters are
    known far better than others."""
    values, ways = np.linalg.eigh(covariance)
    return np.asarray((ways / values) @ ways.T if values[-1] > WIDE * values[0] else np.linalg.inv(covariance))
