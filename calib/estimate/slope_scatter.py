"""What slopes differ by from window to window beyond their noise: a lag of their own, and the noise correction's error.

A lag of d puts -d b into the coefficients on du/dt, b being those on u. Clock models leave some 10 us of it. Those
coefficients are known to a microsecond where the motion is strong, and no common lag explains them: weighed as if they
were exact they would bend S instead (35 us of scatter at 8 Hz put 0.4 % into S_xz, three times its u). The correction
for the reference's noise (calib.excitation.excited) leaves a relative error in all slopes of a window. So both
directions are given the variance that they have, in files and live alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from calib.distributions import chi2_quantile
from calib.estimate.condense import Condensed
from calib.model import Array

PROBABILITY = 0.99  # what noise alone shows once in a hundred recordings is no scatter
LEAST_FREEDOM = 0.5  # degrees of freedom below which rounding, not data, is left over


@dataclass(frozen=True, slots=True, eq=False)
class SlopeScatter:
    """Scatter of the slopes of B windows; loadings (B, 6M) are the slopes' derivatives, whitened by the noise.

    `lag_s` (B,) SD of a window's own lag, `lag` its loading; `attenuation` (B,) relative SD that the noise correction
    leaves, `signal` its loading. `degrees_of_freedom` of the lag's scatter: inf where it was stated.
    """

    lag_s: Array
    lag: Array
    attenuation: Array
    signal: Array
    degrees_of_freedom: float = np.inf

    @staticmethod
    def of(data: Condensed, lag_s: ArrayLike = 0.0, attenuation: ArrayLike = 0.0) -> SlopeScatter:
        """The loadings of condensed windows; `lag_s` and `attenuation` (B,) or one for all."""
        m, blocks = data.channels, len(data.slopes)
        own = np.linalg.pinv(data.root, rcond=1e-9) @ data.slopes  # zero rows of an unexcited channel stay zero
        lag = -np.einsum("brc,bci->bri", data.root[:, :, m:], own[:, :m]) / data.type_a.noise[:, None]
        signal = np.zeros_like(data.slopes)
        signal[:, :m] = data.slopes[:, :m] / data.type_a.noise[:, None]
        return SlopeScatter(
            np.broadcast_to(np.asarray(lag_s, dtype=float), blocks), lag.reshape(blocks, -1),
            np.broadcast_to(np.asarray(attenuation, dtype=float), blocks), signal.reshape(blocks, -1),
        )  # fmt: skip

    @property
    def loaded(self) -> Array:
        """(B, 2, 6M) both loadings, each times its SD."""
        return np.stack([self.lag_s[:, None] * self.lag, self.attenuation[:, None] * self.signal], axis=1)

    def covariance(self) -> Array:
        """(B, 6M, 6M) of the whitened slopes, beside their noise."""
        loaded = self.loaded
        return np.asarray(np.einsum("bkd,bke->bde", loaded, loaded))

    def whiten(self, rows: Array) -> Array:
        """(1 + covariance)^-1/2 of slope rows (B, 6M, ...)."""
        if not (self.lag_s.any() or self.attenuation.any()):
            return rows
        _, size, ways = np.linalg.svd(self.loaded, full_matrices=False)
        less = 1.0 - 1.0 / np.sqrt(1.0 + size**2)
        along = np.einsum("bkd,bd...->bk...", ways, rows)
        return np.asarray(rows - np.einsum("bk,bkd,bk...->bd...", less, ways, along))

    def terms(self, rows: Array) -> dict[str, tuple[Array, float]]:
        """{source: (sum over windows of rows' g g' rows (N, N), degrees of freedom)} of whitened rows (B, 6M, N)."""
        found: dict[str, tuple[Array, float]] = {}
        loaded = self.whiten(np.moveaxis(self.loaded, 1, 2))
        parts = np.einsum("bdk,bdn->kbn", loaded, rows)
        if self.lag_s.any():
            found["lag between windows"] = parts[0].T @ parts[0], self.degrees_of_freedom
        if self.attenuation.any():
            found["correction for the reference's noise"] = parts[1].T @ parts[1], np.inf
        return found


def estimated(stated: SlopeScatter, residual: Array, rows: Array, covariance: Array) -> SlopeScatter:
    """The lag's scatter that slope residuals (B, 6M) show beyond `covariance` (6M, 6M), where it is above the stated.

    By moments along each window's loading; `rows` (B, 6M, N) are the whitened Jacobian's (their squares the leverage).
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
