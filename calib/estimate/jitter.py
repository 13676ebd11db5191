"""Lag that differs from window to window: what clock models leave of two devices' times, some 10 us.

A lag of d puts -d b into the coefficients on du/dt, b being those on u. Those coefficients are known to a microsecond
where the motion is strong, and no common lag explains them: weighed as if they were exact they would bend S instead
(35 us of scatter at 8 Hz put 0.4 % into S_xz, three times its u). So the direction in which a window's lag moves its
slopes is given the variance that it has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.distributions import chi2_quantile
from calib.estimate.condense import Condensed
from calib.model import Array

PROBABILITY = 0.99  # what noise alone shows once in a hundred recordings is no scatter
LEAST_FREEDOM = 0.5  # degrees of freedom below which rounding, not data, is left over


@dataclass(frozen=True, slots=True, eq=False)
class LagScatter:
    """SD `scatter_s` of the lag between blocks and the slopes' derivative by it, `loading` (B, 6M), whitened by noise.

    `degrees_of_freedom`: inf where the scatter was stated.
    """

    scatter_s: float
    loading: Array
    degrees_of_freedom: float = np.inf

    @staticmethod
    def of(data: Condensed, scatter_s: float, degrees_of_freedom: float = np.inf) -> LagScatter:
        """The loading of condensed windows: -b from each block's own slopes."""
        m = data.channels
        own = np.linalg.pinv(data.root, rcond=1e-9) @ data.slopes  # zero rows of an unexcited channel stay zero
        loading = -np.einsum("brc,bci->bri", data.root[:, :, m:], own[:, :m]) / data.type_a.noise
        return LagScatter(scatter_s, loading.reshape(len(loading), -1), degrees_of_freedom)

    def whiten(self, rows: Array) -> Array:
        """(1 + scatter^2 g g')^-1/2 of slope rows (B, 6M, ...), g the loading."""
        if self.scatter_s == 0.0:
            return rows
        size2 = np.einsum("bd,bd->b", self.loading, self.loading)
        less = 1.0 - 1.0 / np.sqrt(1.0 + self.scatter_s**2 * size2)
        share = np.divide(less, size2, out=np.zeros_like(size2), where=size2 > 0.0)
        along = np.einsum("bd,bd...->b...", self.loading, rows)
        return np.asarray(rows - np.einsum("b,bd,b...->bd...", share, self.loading, along))

    def term(self, rows: Array) -> Array:
        """Sum over blocks of rows' g g' rows (N, N), for a scatter of one; rows (B, 6M, N), g whitened as they are."""
        loaded = np.einsum("bd,bdn->bn", self.whiten(self.loading), rows)
        return np.asarray(loaded.T @ loaded)


def estimated(stated: LagScatter, residual: Array, rows: Array, covariance: Array) -> LagScatter:
    """The scatter that slope residuals (B, 6M) show beyond `covariance` (6M, 6M), or the stated one if it is larger.

    By moments along each block's loading; `rows` (B, 6M, N) are the whitened Jacobian's (their squares the leverage).
    """
    size2 = np.einsum("bd,bd->b", stated.loading, stated.loading)
    live = size2 > 0.0
    if not live.any():
        return stated
    way = stated.loading[live] / np.sqrt(size2[live])[:, None]
    shrink = 1.0 / (1.0 + stated.scatter_s**2 * size2[live])
    square = np.einsum("bd,bd->b", way, residual[live]) ** 2 / shrink
    free = 1.0 - np.sum(np.einsum("bd,bdn->bn", way, rows[live]) ** 2, axis=1)
    free = np.clip(free, 0.0, 1.0)
    noise = np.einsum("bd,de,be->b", way, covariance, way)
    freedom, expected = float(free.sum()), float(free @ noise)
    observed = float(square.sum())
    if freedom < LEAST_FREEDOM or observed <= chi2_quantile(PROBABILITY, freedom) / freedom * expected:
        return stated
    scatter_s = float(np.sqrt((observed - expected) / (free @ size2[live])))
    if scatter_s <= stated.scatter_s:
        return stated
    return LagScatter(scatter_s, stated.loading, freedom)
