"""Estimates of the scatter between windows beyond their noise: of the means (offset) and of the slopes.

Both are estimated by moments: the variance of a residual is (1 - leverage) times that of its row, and the excess of the
residuals over the noise is attributed to scatter between windows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.adjustment.solution import Solution
from calib.distributions import chi2_quantile
from calib.model import Array

# No scatter of the slopes is stated. It counts only if noise alone would show as much once in a hundred recordings.
SLOPE_PROBABILITY = 0.99
OFFSET_PROBABILITY = 0.5  # the scatter of the offset is compared with the stated one, and the larger one counts
LEAST_FREEDOM = 0.5  # with fewer degrees of freedom the residuals are only rounding errors


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """An SD between windows: `scatter` in m/s2 (offset) or relative (slopes), and its degrees of freedom.

    `term` (N, N) is (J half)' C (J half) for a scatter of one.
    """

    scatter: float
    degrees_of_freedom: float
    term: Array


@dataclass(frozen=True, slots=True, eq=False)
class BetweenWindows:
    """Scatter of means and slopes; `consistency`: chi-squared against noise and stated scatter, and its expectation."""

    offset: Scatter
    slope: Scatter
    consistency: tuple[float, float]


def between_windows(solution: Solution) -> BetweenWindows:
    """Both scatters, estimated from the residuals of the solution."""
    equations, data = solution.equations, solution.equations.data
    slope, mean = equations.split(solution.residual)
    slope_free, mean_free = equations.split(np.clip(1.0 - solution.leverage, 0.0, 1.0))
    slope_rows, mean_rows = equations.split(solution.jacobian)
    s, m = equations.output_per_mps2, data.channels

    unit = (s * equations.mean_weight) ** 2
    noise = equations.white_share * np.diag(data.type_a.means)
    offset, freedom = _excess(mean**2, mean_free, noise, unit, OFFSET_PROBABILITY)
    term = np.einsum("win,wim->nm", mean_rows * unit[..., None], mean_rows)

    # (B, row, channel, axis); 0 for an output that tells nothing of S
    loading = s * data.root[:, :m, :m, None] * data.telling / data.type_a.noise[:, None, None]
    slope_unit = np.einsum("brca,brca->bra", loading, loading)
    slope_noise = np.broadcast_to(np.diag(data.type_a.slopes).reshape(-1, 3)[:m], slope_unit.shape)
    own, free = slope[:, :m] ** 2, slope_free[:, :m]
    relative, slope_freedom = _excess(own, free, slope_noise, slope_unit, SLOPE_PROBABILITY)
    loaded = np.einsum("brca,bran->bcan", loading, slope_rows[:, :m]).reshape(-1, slope_rows.shape[-1])

    stated = noise + np.where(equations.known[:, None], 1.0 - equations.white_share, 0.0)
    statistic = _statistic(mean**2, mean_free, stated) + _statistic(own, free, slope_noise * (slope_unit > 0.0))
    return BetweenWindows(
        Scatter(offset, freedom, term),
        Scatter(relative, slope_freedom, loaded.T @ loaded),
        (statistic, freedom + slope_freedom),
    )


def _excess(square: Array, free: Array, noise: Array, unit: Array, probability: float) -> tuple[float, float]:
    """Scatter of rows beyond their `noise`, and its degrees of freedom.

    `square` are the squared residuals, `free` is 1 - leverage, `unit` the variance that a scatter of one gives a row.
    The scatter is 0 unless chi-squared is above its quantile of this `probability`.
    """
    live = unit > 0.0
    freedom = float(free[live].sum())
    if freedom < LEAST_FREEDOM:
        return 0.0, 0.0
    observed, expected = float(square[live].sum()), float((free * noise)[live].sum())
    if observed <= max(chi2_quantile(probability, freedom) / freedom, 1.0) * expected:
        return 0.0, freedom
    return float(np.sqrt((observed - expected) / (free * unit)[live].sum())), freedom


def _statistic(square: Array, free: Array, variance: Array) -> float:
    """Chi-squared: the observed sum of squares over the expected one, times the degrees of freedom."""
    live = variance > 0.0
    freedom = float(free[live].sum())
    if freedom < LEAST_FREEDOM:
        return 0.0
    return freedom * float(square[live].sum()) / float((free * variance)[live].sum())
