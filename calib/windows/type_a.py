"""Type A: how much slopes and means of a window scatter, from segment to segment, pooled over all windows.

Residuals are not white (AR(1) 0.99: the true uncertainty is 11 times the white one), so a segment's residual sums
(its scores) are the unit that scatters; the correlation of neighbouring segments is taken into account as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.signal.order_statistics import distinct
from calib.windows.sums import NOISE_FLOOR

Scores = tuple[NDArray[np.bool_], Array]  # flags (D,) of the dimensions that windows have, and their scores (W, K, D)
Flags = np.ndarray[tuple[int], np.dtype[np.bool_]]
Index = NDArray[np.intp]

# Correlation of neighbours above which segments are joined in pairs: they are shorter than 3 correlation times.
RHO_COARSEN = 0.35
FEWEST_FREEDOM = 10.0  # degrees of freedom: from fewer, a mean of squares is off by 40 % and more
LEAST_INFLATION = 0.25  # variance ratios below it are the luck of few segments
LEVELS = 6  # segments are joined in pairs so often at most: half a second becomes sixteen
FEWEST_SEGMENTS = 4.0  # of a window, on average, that are still joined
SINGULAR = 1e-9
SUMS = 10  # numbers for each level, see `score_sums`


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Sums of W windows of K segments each, about one centre for each window.

    `at` (W,): which windows they are. Counts (W, K), x x' (W, K, 2M, 2M), x V' (W, K, 2M, 3), V V' (W, K, 3, 3), sums
    of [x, V] (W, K, 2M + 3); `mean` (W, 2M + 3) is that centre. `noise` (W, 2M): power a sample of the reference's own
    noise, which is no longer in xx but still in the residuals. `silent` (W, 3): that of channels that are not in xx,
    along the axes of V, to which the motion is known that they share. `independent` (W,): share of points that a filter
    left independent.
    """

    at: Index
    count: Array
    xx: Array
    xv: Array
    vv: Array
    total: Array
    mean: Array
    noise: Array
    silent: Array
    independent: Array


@dataclass(frozen=True, slots=True, eq=False)
class TypeA:
    """How much slopes and means scatter.

    `noise` (W, 3): SD of the residuals within each window, and of what silent channels add, output unit. `slopes`
    (6M, 6M) in the order basis, axis and `means` (3, 3): covariance of the whitened slopes and means, identities if the
    residuals were what a filter makes of white noise, independent between axes. `degrees_of_freedom` of both, inf where
    single segments allow no estimate.
    `known`: how far segments tell it, 1 where they are enough; else the rest is what a filter makes of white noise.
    `scores` (2, LEVELS, SUMS): the sums of both from which this follows.
    """

    noise: Array
    slopes: Array
    means: Array
    degrees_of_freedom: float
    known: float
    scores: Array

    def slope_ratio(self, live: Flags) -> float:
        """Variance of the slopes over that of white noise, mean over those with data (`live`, 6M)."""
        return float(np.diag(self.slopes)[live].mean())


def in_order(parts: Sequence[Segments], values: Sequence[Array]) -> Array:
    """Values (W, ...) of the windows of each part, in the order of all windows."""
    if len(parts) == 1:  # they are in order already
        return values[0]
    return np.concatenate(values)[np.argsort(np.concatenate([part.at for part in parts]))]


def pooled(
    parts: Sequence[Segments], roots: Sequence[Array], whiteners: Sequence[Array], *, alike: bool = False
) -> TypeA:
    """Scatter of the whitened scores over all windows; slopes are whitened by T = `whiteners` (W, 2M, 2M) of each part.

    `alike`: all windows are taken to be as noisy as their mean, so that all points weigh the same (Method 3).
    """
    slopes = [np.swapaxes(t, 1, 2) @ (t @ part.xv.sum(1)) for t, part in zip(whiteners, parts, strict=True)]
    left, shared = (in_order(parts, own) for own in zip(*map(_noise, parts, slopes, roots), strict=True))
    noise = np.hypot(left, shared)
    # Scores are summed in one unit. Each in units of its own window's noise would seem too small: it made that noise.
    # They are sums of residuals, which have no noise of silent channels.
    count = in_order(parts, [part.count.sum(1) for part in parts])
    sd = np.sqrt(count @ left**2 / count.sum())
    if alike:
        noise = np.tile(np.sqrt(count @ noise**2 / count.sum()), (len(noise), 1))
    slope_scores, mean_scores = list[Scores](), list[Scores]()
    for part, beta, t, root in zip(parts, slopes, whiteners, roots, strict=True):
        unit = (sd / np.sqrt(part.independent)[:, None])[:, None]
        score = np.einsum("wrc,wkci->wkri", t, part.xv - part.xx @ beta[:, None]) / unit[:, :, None]
        slope_scores += _with_data(score, np.diagonal(root, axis1=1, axis2=2) > 0.0)
        score = (part.total[..., -3:] - part.total[..., :-3] @ beta) / unit
        mean_scores.append((np.ones(3, dtype=bool), score / np.sqrt(part.count.sum(1))[:, None, None]))
    slope_cov, of_slopes, sums = _scatter(slope_scores, 3 * roots[0].shape[-1])
    mean_cov, of_means, mean_sums = _scatter(mean_scores, 3)
    found = [own for own in (of_slopes, of_means) if own is not None]
    freedom = min((own.degrees_of_freedom for own in found), default=np.inf)
    known = min((own.share_known for own in found), default=0.0)
    return TypeA(noise, slope_cov, mean_cov, freedom, known, np.array([sums, mean_sums]))


def _noise(part: Segments, slopes: Array, root: Array) -> tuple[Array, Array]:
    """(W, 3) SD of the residuals of the windows with these slopes, and (W, 3) what silent channels add to it: to their
    noise the motion is known that they share."""
    count, xv, vv = part.count.sum(1), part.xv.sum(1), np.diagonal(part.vv.sum(1), axis1=1, axis2=2)
    moved, m = part.xx.sum(1), part.noise.shape[1] // 2
    xx = moved + count[:, None, None] * part.noise[:, None] * np.eye(2 * m)
    left = vv - 2.0 * np.einsum("wci,wci->wi", slopes, xv) + np.einsum("wci,wcd,wdi->wi", slopes, xx, slopes)
    signal = vv + count[:, None] * part.mean[:, -3:] ** 2
    freedom = count - 1.0 - np.count_nonzero(np.diagonal(root, axis1=1, axis2=2), axis=1)
    floor = NOISE_FLOOR * np.sqrt(signal.max(axis=1) / count)
    spread = np.sqrt(np.maximum(left, 0.0) / np.maximum(freedom, 1.0)[:, None])
    felt, power = (np.einsum("wkk->w", own) for own in (np.swapaxes(slopes, 1, 2) @ moved @ slopes, moved[:, :m, :m]))
    sensitivity2 = np.divide(felt, power, out=np.zeros_like(power), where=power > 0.0)
    return (
        np.maximum(spread, np.where(floor > 0.0, floor, 1.0)[:, None]),
        np.sqrt(sensitivity2[:, None] * part.silent),
    )


def _with_data(score: Array, live: NDArray[np.bool_]) -> list[Scores]:
    """Scores (W, K, 2M, 3) of the slopes with data, of which `live` (W, 2M) tells. A window at rest has none, and tells
    nothing of their scatter."""
    found, pattern = list[Scores](), live @ 2.0 ** np.arange(live.shape[1])
    for alike in (pattern == each for each in distinct(pattern) if each):
        which = live[alike][0]
        own = score[alike][:, :, which]
        found.append((np.repeat(which, 3), own.reshape(*own.shape[:2], -1)))
    return found


def _scatter(scores: Sequence[Scores], size: int) -> tuple[Array, Scattered | None, Array]:
    """Covariance (D, D) of a window's summed scores, D = `size`, what it rests on, and `score_sums`."""
    sums = score_sums([s for _, s in scores])
    found = scattered(sums)
    if found is None:
        return np.eye(size), None, sums
    covariance, freedom = np.zeros((size, size)), np.zeros(size)
    for live, s in scores:
        for _ in range(found.level):
            s = _paired(s)
        covariance[np.ix_(live, live)] += s.shape[1] * _flat(s).T @ _flat(s)
        freedom[live] += len(s) * (s.shape[1] - 1.0)
    told = freedom >= 1.0
    weight = np.divide(1.0, np.sqrt(freedom), out=np.zeros(size), where=told)
    return covariance * np.outer(weight, weight) * found.inflation + np.diag(~told * found.variance), found, sums


@dataclass(frozen=True, slots=True)
class Scattered:
    """How much scores scatter: the `variance` of a window's sum of them, over that of white noise, of segments joined
    `level` times; it has the `inflation` by which neighbours that correlate make it larger. `freedom`: segments less
    one, of all windows."""

    level: int
    variance: float
    inflation: float
    freedom: float

    @property
    def degrees_of_freedom(self) -> float:
        """Of the variance. With that of a score and twice the covariance of neighbours, gamma0 + 2 gamma1, it scatters
        as a mean of squares of a third of the segments: of n white scores 2 (1 + 2) / n in the place of 2 / n, with
        gamma1 / gamma0 = 0.3 little less (Bartlett's formula)."""
        return self.freedom / 3.0 if self.inflation > 1.0 else self.freedom

    @property
    def share_known(self) -> float:
        """How far segments tell the variance, 1 where they are enough."""
        return min(self.freedom / FEWEST_FREEDOM, 1.0)


def score_sums(scores: Sequence[Array]) -> Array:
    """(LEVELS, SUMS) what scores (W, K, D) of windows tell of their scatter. Those of other windows add to them.

    For segments as they are, and joined in pairs once, twice, ...: degrees of freedom, windows, segments, W D, and the
    mean square of a sum of scores; of windows with three segments and more also what a score's variance and the
    covariance of two neighbours contribute to the last two numbers, the sums of squares and of products of neighbours.
    """
    found = np.zeros((LEVELS, SUMS))
    for own in found:
        for s in scores:
            w, k, d = s.shape
            square = k * float(np.vdot(s, s)) / max(d, 1)
            own[:5] += w * (k - 1.0), w, w * k, w * d, square
            if k > 2:
                # With r = g - mean(g), E sum r_k^2 and E sum r_k r_k+1 are linear in both.
                neighbours = (k - 1.0) * (1.0 - 2.0 * (k + 1.0) / k**2) + 2.0 / k
                product = k * float(np.vdot(s[:, 1:], s[:, :-1])) / max(d, 1)
                own[5:] += w * (k - 1.0), w * (k - 1.0) / k, w * neighbours, square, product
        scores = [_paired(s) for s in scores]
    return found


def scattered(sums: Array) -> Scattered | None:
    """What `score_sums` (LEVELS, SUMS) say; None where single segments allow no estimate."""
    for level, (freedom, windows, segments, dimensions, total, own, ends, neighbours, square, product) in enumerate(
        sums.tolist()
    ):
        if freedom < 1.0 or not dimensions:
            return None
        # own gamma0 - 2 ends gamma1 = square, neighbours gamma1 - ends gamma0 = product
        variance, determinant = total / freedom, own * neighbours - 2.0 * ends**2
        if abs(determinant) < SINGULAR:
            return Scattered(level, variance, 1.0, freedom)
        gamma0 = (neighbours * square + 2.0 * ends * product) / determinant
        gamma1 = (ends * square + own * product) / determinant
        if gamma0 <= 0.0:
            return Scattered(level, variance, 1.0, freedom)
        rho, typical = gamma1 / gamma0, segments / windows
        if rho > RHO_COARSEN and typical >= FEWEST_SEGMENTS and level + 1 < len(sums):
            continue
        if rho <= 1.0 / np.sqrt(freedom * dimensions / windows):  # within its own SD of none at all
            return Scattered(level, variance, 1.0, freedom)
        naive = gamma0 - 2.0 * gamma1 / typical  # what the variance above expects, neighbours being correlated
        inflation = max(1.0, (gamma0 + 2.0 * (1.0 - 1.0 / typical) * gamma1) / naive)
        return Scattered(level, variance * inflation, inflation, freedom)
    raise AssertionError("the last level is never joined again")


def _flat(scores: Array) -> Array:
    return scores.reshape(-1, scores.shape[-1])


def _paired(scores: Array) -> Array:
    """Neighbours (W, K, D) summed; an odd last one goes with the pair before it, a single one stays."""
    if scores.shape[1] < 2:
        return scores
    even = scores[:, : scores.shape[1] // 2 * 2]
    pairs = np.asarray(even.reshape(len(even), even.shape[1] // 2, 2, even.shape[2]).sum(2))
    if even.shape[1] < scores.shape[1]:
        pairs[:, -1] += scores[:, -1]
    return pairs
