"""The solution of files: the window equations with priors, all windows at one time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.adjustment.equations import Equations
from calib.estimate.chain import solved
from calib.estimate.determined import Flags
from calib.estimate.gauss_newton import Linearised, gauss_newton
from calib.estimate.nuisances import Priors
from calib.estimate.reference_share import ReferenceShare
from calib.model import Array

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
    root = np.asarray(np.linalg.cholesky(precision).T, dtype=np.float64)
    begin = mean.copy()
    begin[12:][[not term.kind.stated for term in equations.nuisances.terms]] = 0.0

    def lines_at(x: Array) -> Linearised:
        residual, jacobian = equations.at(x[0]).stacked()
        return Linearised(np.column_stack([root, root @ (mean - x[0])]), [np.column_stack([jacobian, residual])])

    found = gauss_newton(lines_at, begin[None], floor=ROUNDING * scale)
    d, half = solved(found.root)
    (rows,) = found.lines.rows
    return Solution(equations, found.x[0] + d, half, rows[:, -1], rows[:, :-1] @ half, mean, precision, bounded)


def slope_residuals(solution: Solution) -> tuple[Array, Array]:
    """Whitened residuals (B, 6M) of the slopes and their rows (B, 6M, N) of J half."""
    residual, _ = solution.equations.split(solution.residual)
    rows, _ = solution.equations.split(solution.jacobian)
    return residual.reshape(len(residual), -1), rows.reshape(len(rows), -1, rows.shape[-1])


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


def share_after(solution: Solution) -> ReferenceShare | None:
    """The share of the only reference of an adjustment, whose name is not known; None where it states no error."""
    terms = solution.equations.nuisances.terms
    own = [12 + j for j, term in enumerate(terms) if term.kind.of_certificate]
    if not own:
        return None
    chosen = [terms[k - 12] for k in own]
    applied = np.array([term.applied for term in chosen])
    u = np.array([term.uncertainty for term in chosen])
    derivative = solution.half @ solution.half[own].T / u**2
    return ReferenceShare(
        "",
        np.ones(1),
        tuple(term.name for term in chosen),
        tuple(term.kind.name for term in chosen),
        solution.prior_mean[own] + applied,
        u,
        solution.x[own] + applied,
        derivative[own],
        derivative[:12],
    )
