"""What windows differ by beyond their own noise and what was stated: of their means (offset) and of their slopes.

By moments: the variance of a residual is (1 - leverage) times that of its row, and what is more than the noise says
is scatter between windows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.distributions import chi2_quantile
from calib.estimate.gauss_newton import Solution
from calib.model import Array

# Slopes have no stated scatter, so theirs must be beyond what noise alone shows once in a hundred recordings.
SLOPE_PROBABILITY = 0.99
OFFSET_PROBABILITY = 0.5  # the offset's is compared with the stated one anyway, the larger counts
LEAST_FREEDOM = 0.5  # degrees of freedom below which rounding, not data, is left over


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """`scatter` in m/s2 (offset) or relative (slopes); `term` (N, N) is (J half)' C (J half) for a scatter of one."""

    scatter: float
    degrees_of_freedom: float
    term: Array


@dataclass(frozen=True, slots=True, eq=False)
class BetweenWindows:
    """Scatter of means and slopes; `consistency`: chi-squared against noise and stated scatter, and its mean."""

    offset: Scatter
    slope: Scatter
    consistency: tuple[float, float]


def between_windows(solution: Solution) -> BetweenWindows:
    """Estimate both scatters from what the solution leaves."""
    equations, data = solution.equations, solution.equations.data
    slope, mean = equations.split(solution.residual)
    slope_free, mean_free = equations.split(np.clip(1.0 - solution.leverage, 0.0, 1.0))
    slope_rows, mean_rows = equations.split(solution.jacobian)
    s, m = equations.output_per_mps2, data.channels

    unit = (s * equations.mean_weight) ** 2
    noise = equations.white_share * np.diag(data.type_a.means)
    offset, freedom = _excess(mean**2, mean_free, noise, unit, OFFSET_PROBABILITY)
    term = np.einsum("win,wim->nm", mean_rows * unit[..., None], mean_rows)

    loading = s * data.root[:, :m, :m, None] / data.type_a.noise[:, None, None]  # (B, row, channel, axis)
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
    """Scatter beyond `noise` of rows that a scatter of one gives the variance `unit`, and its degrees of freedom."""
    live = unit > 0.0
    freedom = float(free[live].sum())
    if freedom < LEAST_FREEDOM:
        return 0.0, 0.0
    observed, expected = float(square[live].sum()), float((free * noise)[live].sum())
    if observed <= max(chi2_quantile(probability, freedom) / freedom, 1.0) * expected:
        return 0.0, freedom
    return float(np.sqrt((observed - expected) / (free * unit)[live].sum())), freedom


def _statistic(square: Array, free: Array, variance: Array) -> float:
    """Chi-squared: observed over expected, times the degrees of freedom."""
    live = variance > 0.0
    freedom = float(free[live].sum())
    if freedom < LEAST_FREEDOM:
        return 0.0
    return freedom * float(square[live].sum()) / float((free * variance)[live].sum())
