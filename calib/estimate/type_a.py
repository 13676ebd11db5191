"""Type A: how much slopes and means of a window scatter, from segment to segment, pooled over all windows.

Residuals are not white (AR(1) 0.99: the true uncertainty is 11 times the white one), so a segment's residual sums
(its scores) are the unit that scatters; the correlation of neighbouring segments is taken into account as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.excitation.sums import NOISE_FLOOR
from calib.model import Array

Flags = np.ndarray[tuple[int], np.dtype[np.bool_]]

# Correlation of neighbours above which segments are joined in pairs: they are shorter than 3 correlation times.
RHO_COARSEN = 0.35
FEWEST_FREEDOM = 10.0  # degrees of freedom: from fewer, a mean of squares is off by 40 % and more
LEAST_INFLATION = 0.25  # variance ratios below it are the luck of few segments


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Sums of K segments about one centre: counts (K,), x x' (K, 2M, 2M), x V' (K, 2M, 3), V V' (K, 3, 3), sums of
    [x, V] (K, 2M + 3); `mean` (2M + 3,) is that centre. `noise` (2M,): power a sample of the reference's own noise,
    which is no longer in xx but still in the residuals. `independent`: share of points that a filter left independent.
    """

    count: Array
    xx: Array
    xv: Array
    vv: Array
    total: Array
    mean: Array
    noise: Array
    independent: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class TypeA:
    """How much slopes and means scatter.

    `noise` (W, 3): SD of the residuals within each window, output unit. `slopes` (6M, 6M) in the order basis, axis and
    `means` (3, 3): covariance of the whitened slopes and means, identities if the residuals were what a filter makes of
    white noise, independent between axes. `degrees_of_freedom` of both, inf where single segments allow no estimate.
    """

    noise: Array
    slopes: Array
    means: Array
    degrees_of_freedom: float

    def slope_ratio(self, live: Flags) -> float:
        """Variance of the slopes over that of white noise, mean over those with data (`live`, 6M)."""
        return float(np.diag(self.slopes)[live].mean())


def pooled(
    windows: Sequence[Segments], roots: Sequence[Array], whiteners: Sequence[Array], *, alike: bool = False
) -> TypeA:
    """Scatter of the whitened scores over all windows; slopes are whitened by T = `whiteners`.

    `alike`: all windows are taken to be as noisy as their mean, so that all points weigh the same (Method 3).
    """
    slopes = [t.T @ (t @ w.xv.sum(0)) for t, w in zip(whiteners, windows, strict=True)]
    noise = np.array([_noise(*each) for each in zip(windows, slopes, roots, strict=True)])
    # Scores are summed in one unit. Each in units of its own window's noise would seem too small: it made that noise.
    count = np.array([w.count.sum() for w in windows])
    sd = np.sqrt(count @ noise**2 / count.sum())
    if alike:
        noise = np.tile(sd, (len(noise), 1))
    size = roots[0].shape[0]
    slope_scores, mean_scores = [], []
    for window, beta, t in zip(windows, slopes, whiteners, strict=True):
        score = np.einsum("rc,kci->kri", t, window.xv - window.xx @ beta) / (sd / np.sqrt(window.independent))
        slope_scores.append(score.reshape(len(score), 3 * size))
        score = (window.total[:, -3:] - window.total[:, :-3] @ beta) / (sd / np.sqrt(window.independent))
        mean_scores.append(score / np.sqrt(window.count.sum()))
    live = np.repeat([any(r[j, j] > 0.0 for r in roots) for j in range(size)], 3)
    slope_cov, slope_dof = _scatter(slope_scores, live)
    mean_cov, mean_dof = _scatter(mean_scores, np.ones(3, dtype=bool))
    return TypeA(noise, slope_cov, mean_cov, min(slope_dof, mean_dof))


def _noise(window: Segments, slopes: Array, root: Array) -> Array:
    """(3,) SD of the residuals of a window with these slopes."""
    count, xv, vv = float(window.count.sum()), window.xv.sum(0), np.diag(window.vv.sum(0))
    xx = window.xx.sum(0) + count * np.diag(window.noise)
    left = vv - 2.0 * np.einsum("ci,ci->i", slopes, xv) + np.einsum("ci,cd,di->i", slopes, xx, slopes)
    signal = vv + count * window.mean[-3:] ** 2
    freedom = count - 1.0 - np.count_nonzero(np.diag(root))
    floor = NOISE_FLOOR * np.sqrt(signal.max() / count) or 1.0
    return np.asarray(np.sqrt(np.maximum(left, 0.0) / max(freedom, 1.0)).clip(min=floor))


def _scatter(scores: list[Array], live: Flags) -> tuple[Array, float]:
    """Covariance (D, D) of a window's summed scores and its degrees of freedom; `live` (D,) are those with data."""
    lengths = np.array([len(s) for s in scores])
    freedom = float(np.sum(lengths - 1))
    if freedom < 1 or not live.any():
        return np.eye(len(live)), np.inf
    covariance = np.sum([len(s) * s.T @ s for s in scores], axis=0) / freedom
    gamma0, gamma1 = _neighbours([s[:, live] for s in scores])
    if gamma0 <= 0.0:
        return covariance, freedom
    rho = gamma1 / gamma0
    if rho > RHO_COARSEN and lengths.max() >= 4:
        return _scatter([_paired(s) for s in scores], live)
    if rho <= 1.0 / np.sqrt(freedom * live.sum()):  # within its own SD of none at all
        return covariance, freedom
    typical = float(lengths.mean())
    naive = gamma0 - 2.0 * gamma1 / typical  # what the covariance above expects, neighbours being correlated
    inflation = max(1.0, (gamma0 + 2.0 * (1.0 - 1.0 / typical) * gamma1) / naive)
    return covariance * inflation, freedom / (1.0 + 0.5 * inflation)  # rho itself is known from as little


def _neighbours(scores: list[Array]) -> tuple[float, float]:
    """Variance of a score and covariance of two neighbours, unbiased though each window's scores sum to zero.

    With K scores g and r = g - mean(g): E sum r_k^2 and E sum r_k r_{k+1} are linear in both; solved over all windows.
    """
    scores = [s for s in scores if len(s) > 2]
    k = np.array([float(len(s)) for s in scores])
    none, mean_square = np.zeros_like(k), np.array([k, 2.0 * (k - 1.0)]) / k**2  # of mean(g), by gamma0, gamma1
    matrix = np.array(
        [
            (np.array([k, none]) - k * mean_square).sum(axis=1),
            (np.array([none, k - 1.0]) - (k + 1.0) * mean_square + 2.0 / k).sum(axis=1),
        ]
    )
    own = sum(len(s) * float(np.vdot(s, s)) for s in scores)
    next_to = sum(len(s) * float(np.vdot(s[1:], s[:-1])) for s in scores)
    observed = np.array([own, next_to]) / max(scores[0].shape[1] if scores else 1, 1)
    if abs(np.linalg.det(matrix)) < 1e-9:
        return 0.0, 0.0
    gamma0, gamma1 = np.linalg.solve(matrix, observed)
    return float(gamma0), float(gamma1)


def _paired(scores: Array) -> Array:
    """Neighbours summed; an odd last one goes with the pair before it, a single one stays."""
    if len(scores) < 2:
        return scores
    even = scores[: len(scores) // 2 * 2]
    pairs = np.asarray(even.reshape(-1, 2, even.shape[1]).sum(1))
    if len(even) < len(scores):
        pairs[-1] += scores[-1]
    return pairs
