"""Scatter of the slopes between windows beyond their noise: each window's own lag, and the noise correction's error.

A lag d adds -d b to the coefficients on du/dt, where b are the coefficients on u. Clock models leave a lag of some
10 us, which differs between windows. With strong motion those coefficients are known to a microsecond, and no common
lag explains their differences. If they were weighted as exact, S would be wrong instead: a scatter of 35 us at 8 Hz
changed S_xz by 0.4 %, three times its u. The correction for the reference's noise (calib.windows.excited) leaves a
relative error in all slopes of a window. Both effects are therefore part of the covariance of the slopes, for files and
for live data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from calib.distributions import chi2_quantile
from calib.model import Array, own_channels
from calib.windows.condense import Condensed, regressed

PROBABILITY = 0.99  # confidence of the test for scatter: noise alone passes it once in a hundred recordings
LEAST_ROOT = 1e-6  # relative: a direction that moves less was not excited
LEAST_FREEDOM = 0.5  # with fewer degrees of freedom the residuals are only rounding errors


@dataclass(frozen=True, slots=True, eq=False)
class SlopeScatter:
    """Scatter of the slopes of B windows. A loading (B, 6M) is the derivative of the slopes, whitened by the noise.

    `lag_s` (B,) is the SD of a window's own lag, `lag` its loading; `u_noise` (B,) is the relative SD of the power of
    the reference's noise, which was subtracted, `corrected` its loading. `degrees_of_freedom` of the lag's scatter: inf
    if it was stated.
    """

    lag_s: Array
    lag: Array
    u_noise: Array
    corrected: Array
    degrees_of_freedom: float = np.inf

    @staticmethod
    def of(
        data: Condensed, lag_s: ArrayLike = 0.0, u_noise: ArrayLike = 0.0, shares: Array | None = None
    ) -> SlopeScatter:
        """The scatter of condensed windows; `lag_s` and `u_noise` are (B,), or one number for all windows. `shares`
        (B, 2M): noise of the reference over its motion, as power; None where it has none.
        """
        m, blocks = data.channels, len(data.slopes)
        own = regressed(data.root, data.slopes)
        noise = np.where(data.telling, data.type_a.noise, np.inf)[:, None]
        lag = -np.einsum("brc,bci->bri", data.root[:, :, m:], own[:, :m]) / noise
        corrected = np.zeros_like(data.slopes) if shares is None else _corrected(data, own, shares) / noise
        return SlopeScatter(
            np.broadcast_to(np.asarray(lag_s, dtype=float), blocks), lag.reshape(blocks, -1),
            np.broadcast_to(np.asarray(u_noise, dtype=float), blocks), corrected.reshape(blocks, -1),
        )  # fmt: skip

    @property
    def loaded(self) -> Array:
        """(B, 2, 6M) both loadings, each multiplied by its SD."""
        return np.stack([self.lag_s[:, None] * self.lag, self.u_noise[:, None] * self.corrected], axis=1)

    def covariance(self) -> Array:
        """(B, 6M, 6M) covariance of the whitened slopes due to the scatter, without their noise."""
        loaded = self.loaded
        return np.asarray(np.einsum("bkd,bke->bde", loaded, loaded))

    def whiten(self, rows: Array) -> Array:
        """Slope rows (B, 6M, ...) multiplied by (1 + covariance)^-1/2."""
        if not (self.lag_s.any() or self.u_noise.any()):
            return rows
        less, ways = _less(self)
        along = np.einsum("bkd,bd...->bk...", ways, rows)
        return np.asarray(rows - np.einsum("bk,bkd,bk...->bd...", less, ways, along))

    def terms(self, rows: Array) -> dict[str, tuple[Array, float]]:
        """Contributions to the budget: {source: (sum over windows of rows' g g' rows (N, N), degrees of freedom)}.

        `rows` (B, 6M, N) are the whitened rows of J half, g the whitened loading times its SD.
        """
        found: dict[str, tuple[Array, float]] = {}
        loaded = self.whiten(np.moveaxis(self.loaded, 1, 2))
        parts = np.einsum("bdk,bdn->kbn", loaded, rows)
        if self.lag_s.any():
            found["lag between windows"] = parts[0].T @ parts[0], self.degrees_of_freedom
        if self.u_noise.any() and self.corrected.any():
            found["correction for the reference's noise"] = parts[1].T @ parts[1], np.inf
        return found


def _corrected(data: Condensed, own: Array, shares: Array) -> Array:
    """(B, 2M, 3) what noise of the reference, with `shares` (B, 2M) as in SlopeScatter.of, takes from the slopes.

    With R'R = P the power of the motion, noise N takes P^-1 N b from b: most where the motion is weakest. Beside a
    tri-axial reference b and the shares are those of all windows together: with its own ones, a window would count the
    more, the less it shows. Of du/dt, b is mostly noise.
    """
    m = data.channels
    u = np.arange(2 * m) < m
    if own_channels(m) == 3:
        moved, followed = data.root.mT @ data.root, data.root.mT @ data.slopes
        own = np.linalg.pinv(moved.sum(axis=0), rcond=LEAST_ROOT**2, hermitian=True) @ followed.sum(axis=0)
        power = np.diagonal(moved, axis1=1, axis2=2)
        shares = np.sum(power * shares, axis=0) / np.maximum(power.sum(axis=0), np.finfo(float).tiny)
    noise = np.sum(data.root**2, axis=1) * np.where(u, shares, 0.0)
    return np.asarray(np.linalg.pinv(data.root.mT, rcond=LEAST_ROOT) @ (noise[..., None] * own))


@lru_cache(maxsize=2)  # each step of a solution asks for it
def _less(scatter: SlopeScatter) -> tuple[Array, Array]:
    """By which share (B, 2) rows lose weight along directions (B, 2, 6M)."""
    _, size, ways = np.linalg.svd(scatter.loaded, full_matrices=False)
    return 1.0 - 1.0 / np.sqrt(1.0 + size**2), ways


def estimated(stated: SlopeScatter, residual: Array, rows: Array, covariance: Array) -> SlopeScatter:
    """The scatter with the lag's SD that the residuals show, if that is larger than the stated one; else `stated`.

    `residual` (B, 6M) are the slope residuals, `covariance` (6M, 6M) their noise, `rows` (B, 6M, N) the whitened rows
    of J half, whose squares are the leverage. The SD is estimated by moments along the loading of each window.
    """
    size2 = np.einsum("bd,bd->b", stated.lag, stated.lag)
    live = size2 > 0.0
    if not live.any():
        return stated
    way = stated.lag[live] / np.sqrt(size2[live])[:, None]
    whitened = np.einsum("bd,bd->b", way, stated.whiten(stated.lag)[live]) / np.sqrt(size2[live])
    square = np.einsum("bd,bd->b", way, residual[live]) ** 2 / whitened**2
    free = np.clip(1.0 - np.sum(np.einsum("bd,bdn->bn", way, rows[live]) ** 2, axis=1), 0.0, 1.0)
    noise = np.einsum("bd,de,be->b", way, covariance, way)
    freedom, expected, observed = float(free.sum()), float(free @ noise), float(square.sum())
    if freedom < LEAST_FREEDOM or observed <= chi2_quantile(PROBABILITY, freedom) / freedom * expected:
        return stated
    scatter_s = float(np.sqrt((observed - expected) / (free @ size2[live])))
    larger = np.maximum(stated.lag_s, scatter_s)
    return replace(stated, lag_s=larger, degrees_of_freedom=freedom) if scatter_s > stated.lag_s.max() else stated
