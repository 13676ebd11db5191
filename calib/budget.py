"""Where the uncertainty of S and Q comes from: one standard uncertainty a source, and the degrees of freedom of all.

The covariance is that of the estimate, H^-1 (J' C J + P) H^-1 with C the scatter that the windows show and P the
priors; a term of C or P is a source. It stays true where residuals are coloured, though they are weighted as white.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.distributions import chi2_quantile
from calib.gauss_newton import Solution
from calib.model import Array

# Scatter of slopes between windows that noise alone would show once in a hundred recordings is left to noise.
SCATTER_PROBABILITY = 0.99


@dataclass(frozen=True, slots=True, eq=False)
class Budget:
    """`covariance` (N, N) of [S, Q, nuisances]; `contributions` {source: (12,)}, whose squares sum to its diagonal.

    `degrees_of_freedom` (12,) effective (Welch-Satterthwaite, GUM G.2b). `offset_scatter_mps2` between windows as
    estimated, `slope_scatter` relative; both 0 where noise and priors explain all.
    """

    covariance: Array
    contributions: Mapping[str, Array]
    degrees_of_freedom: Array
    offset_scatter_mps2: float
    slope_scatter: float
    consistency: tuple[float, float]  # chi-squared of the window equations against what was stated, and its mean


def budget(solution: Solution, stated_offset_scatter_mps2: float) -> Budget:
    """Sources of the covariance at a solution."""
    seen = _Scatter(solution)
    noise = _type_a(solution)
    sources = {"type A": (noise, solution.equations.data.type_a.degrees_of_freedom)}
    if stated_offset_scatter_mps2 > 0.0:
        larger = max(stated_offset_scatter_mps2, seen.offset)
        freedom = seen.offset_freedom if larger > stated_offset_scatter_mps2 else np.inf
        sources["offset between windows"] = (larger**2 * seen.offset_term, freedom)
    if seen.slope > 0.0:
        sources["slopes between windows"] = (seen.slope**2 * seen.slope_term, seen.slope_freedom)
    inverse = solution.inverse
    covariances = {name: (inverse @ middle @ inverse, freedom) for name, (middle, freedom) in sources.items()}
    own = inverse[:, :12]
    covariances["prior of S and Q"] = (own @ solution.prior_precision[:12, :12] @ own.T, np.inf)
    for j, term in enumerate(solution.equations.nuisances.terms, start=12):
        moved = inverse[:, j] / term.uncertainty
        before = covariances.get(term.source, (np.zeros_like(inverse), np.inf))[0]
        covariances[term.source] = (before + np.outer(moved, moved), np.inf)
    total = np.sum([c for c, _ in covariances.values()], axis=0)
    variances = {name: np.diag(c)[:12] for name, (c, _) in covariances.items()}
    spent = sum(variances[name] ** 2 / freedom for name, (_, freedom) in covariances.items())
    with np.errstate(divide="ignore"):
        effective = np.diag(total)[:12] ** 2 / spent
    return Budget(
        covariance=total,
        contributions={name: np.sqrt(v) for name, v in variances.items()},
        degrees_of_freedom=effective,
        offset_scatter_mps2=seen.offset,
        slope_scatter=seen.slope,
        consistency=seen.consistency,
    )


def _type_a(solution: Solution) -> Array:
    """J' C J (N, N) of the scatter within windows."""
    equations = solution.equations
    slope_rows, mean_rows = equations.split(solution.jacobian)
    type_a = equations.data.type_a
    slope_rows = slope_rows.reshape(len(slope_rows), -1, slope_rows.shape[-1])
    mean_rows = mean_rows * np.sqrt(equations.white_share)[..., None]
    return _quadratic(slope_rows, type_a.slopes) + _quadratic(mean_rows, type_a.means)


def _quadratic(rows: Array, covariance: Array) -> Array:
    """Sum over blocks of rows' C rows: rows (B, D, N), C (D, D)."""
    return np.asarray(np.tensordot(rows, covariance @ rows, axes=([0, 1], [0, 1])))


class _Scatter:
    """What windows differ by beyond their noise: of their means (m/s2) and of their slopes (relative).

    By moments: a residual's variance is (1 - leverage) times that of its row. The `..._term` are J' C J for a scatter
    of one, the `..._freedom` the degrees of freedom of the estimates.
    """

    def __init__(self, solution: Solution) -> None:
        equations, data = solution.equations, solution.equations.data
        slope, mean = equations.split(solution.residual)
        slope_free, mean_free = equations.split(np.clip(1.0 - solution.leverage, 0.0, 1.0))
        slope_rows, mean_rows = equations.split(solution.jacobian)
        s, noise, type_a = equations.output_per_mps2, data.type_a.noise, data.type_a

        unit = (s * equations.mean_weight) ** 2
        expected = equations.white_share * np.diag(type_a.means)
        self.offset_freedom = float(mean_free[equations.known].sum())
        excess = float((mean**2 - mean_free * expected).sum())
        self.offset = np.sqrt(max(excess, 0.0) / max(float((mean_free * unit).sum()), np.finfo(float).tiny))
        self.offset_term = np.einsum("win,wi,wim->nm", mean_rows, unit, mean_rows)

        m = data.channels
        loading = s * data.root[:, :m, :m, None] / noise  # (B, row, channel, axis)
        unit_slope = np.einsum("brca,brca->bra", loading, loading)
        spread = np.diag(type_a.slopes).reshape(2 * m, 3)[:m]
        free, own = slope_free[:, :m], slope[:, :m]
        self.slope_freedom = float(free[unit_slope > 0.0].sum())
        expected_slope = float((free * spread)[unit_slope > 0.0].sum())
        observed = float((own[unit_slope > 0.0] ** 2).sum())
        limit = chi2_quantile(SCATTER_PROBABILITY, self.slope_freedom) / max(self.slope_freedom, 1e-9)
        shared = float((free * unit_slope).sum())
        excess_slope = observed - expected_slope if observed > limit * expected_slope and shared > 0.0 else 0.0
        self.slope = float(np.sqrt(excess_slope / shared)) if excess_slope > 0.0 else 0.0
        loaded = np.einsum("brca,bran->bcan", loading, slope_rows[:, :m])
        self.slope_term = np.einsum("bcan,bcam->nm", loaded, loaded)

        stated = (
            equations.white_share * np.diag(type_a.means) + (1.0 - equations.white_share) * equations.known[:, None]
        )
        self.consistency = (
            observed / np.maximum(expected_slope / max(self.slope_freedom, 1e-9), np.finfo(float).tiny)
            + float((mean**2 / np.where(stated > 0.0, stated, 1.0)).sum()),
            self.slope_freedom + self.offset_freedom,
        )
