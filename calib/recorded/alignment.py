"""The sensor's lag behind the reference over the time of a recording: it changes if the two clocks run apart.

Stamps from a recorder's own clock are evenly spaced, but the rate of that clock may be wrong by 10 to 50 ppm: the lag
then changes by about a millisecond per minute. Since V(t) = S a(t - lag), each segment of motion shows the lag in the
coefficient on the reference's derivative.

Of a tone on an ellipse, du/dt is a sum of the channels of u: the sensitivities of such a window can make any lag, and
it tells none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.model import Array, Window, WindowSums
from calib.windows.excited import NOISE_LEFT
from calib.windows.sums import NOISE_FLOOR, factor, pool

LEAST_SEGMENTS = 6  # two unknowns, and four degrees of freedom for the scatter
SIGNIFICANT = 5.0  # standard uncertainties; to correct a smaller drift would improve nothing
UNSEEN = 1e-6  # relative to the strongest direction of motion: weaker directions are rounding errors
LEAST_RATE = 1e-6  # clocks fitted to stamps of one gateway differ by 0.2 ppm, two quartz clocks by several ppm


@dataclass(frozen=True, slots=True)
class LagDrift:
    """Lag over time: `lag_s` at `time_s`; it changes by `rate` (s/s), whose standard uncertainty is `u_rate`."""

    time_s: float
    lag_s: float
    rate: float
    u_rate: float

    @property
    def significant(self) -> bool:
        """Whether the data show that the two clocks run apart."""
        return abs(self.rate) > max(SIGNIFICANT * self.u_rate, LEAST_RATE)


def drift(windows: Sequence[Window]) -> LagDrift | None:
    """The straight line through the lags of all segments of the used windows of kind "motion" that tell a lag.

    None if there are fewer than LEAST_SEGMENTS.
    """
    moving = [w for w in windows if w.used and w.kind == "motion"]
    told = [(w, u_s) for w in moving if np.isfinite(u_s := u_common_lag_s(w))]
    found = [(lags, u_s) for w, u_s in told if len(lags := segment_lags(w))]
    if sum(len(lags) for lags, _ in found) < LEAST_SEGMENTS:
        return None
    time_s, lag_s, u_s = np.concatenate([lags for lags, _ in found]).T
    weight = 1.0 / u_s**2
    middle = float(weight @ time_s / weight.sum())
    design = np.column_stack([np.ones(len(lag_s)), time_s - middle, lag_s])
    products, at = np.zeros((3, 3)), 0
    for lags, common_s in found:
        rows, own = design[at : at + len(lags)], weight[at : at + len(lags)]
        mean = own @ rows / (own.sum() + 1.0 / common_s**2)  # the error that all segments share is a part of the mean
        products += rows.T @ (own[:, None] * rows) - np.outer(own @ rows, mean)
        at += len(lags)
    inverse = np.linalg.pinv(products[:2, :2], hermitian=True)
    line = inverse @ products[:2, 2]
    scatter = float(products[2, 2] - line @ products[:2, 2]) / (len(lag_s) - 2)
    return LagDrift(middle, float(line[0]), float(line[1]), float(np.sqrt(inverse[1, 1] * max(scatter, 1.0))))


def u_common_lag_s(window: Window) -> float:
    """The standard uncertainty in s of the lag that all segments of a window share: what u tells of du/dt, the window's
    sensitivities may tell of V in the place of a lag. inf where noise alone is left of du/dt.
    """
    whole, m = pool(window.sums), window.sums.reference_channels
    power = whole.scatter[0]
    direct, noise = _of_window(window.sums)
    shared = np.linalg.pinv(power[:m, :m], rcond=UNSEEN, hermitian=True) @ power[:m, m : 2 * m]
    left = power[m : 2 * m, m : 2 * m] - power[m : 2 * m, :m] @ shared
    if window.reference_noise is not None and len(window.reference_noise[0]) == m:
        own, of_rate = whole.count[0] * window.reference_noise**2
        left_by_noise = np.diag(of_rate) + shared.T @ (own[:, None] * shared)
        left = left - (1.0 + NOISE_LEFT) * left_by_noise
    told = np.maximum(np.einsum("ji,jk,ki->i", direct, left, direct), 0.0)
    return float(np.sqrt(told @ noise) / told.sum()) if told.any() else np.inf


def segment_lags(window: Window) -> Array:
    """(K, 3) for each segment of a window: its middle, the lag, and u(lag) for white noise, all in s.

    b (m, 3) are the sensitivities of the whole window; each segment then has one unknown: V - b'u = -lag b'du/dt. A
    segment without motion has no row.
    """
    sums = window.sums
    m = sums.reference_channels
    direct, noise = _of_window(sums)
    u, du, out = slice(0, m), slice(m, 2 * m), slice(2 * m, 2 * m + 3)
    power = np.einsum("ji,kjl,li->ki", direct, sums.scatter[:, du, du], direct)  # of b'du/dt, (K, 3)
    common = np.einsum("ji,kji->ki", direct, sums.scatter[:, du, out] - sums.scatter[:, du, u] @ direct)
    size = power.sum(axis=1)
    told = size > 0.0
    ends = np.cumsum(sums.count)
    middle = window.start_s + (ends - 0.5 * sums.count) / ends[-1] * (window.stop_s - window.start_s)
    lag = -common.sum(axis=1)[told] / size[told]
    return np.column_stack([middle[told], lag, np.sqrt(power[told] @ noise) / size[told]])


def _of_window(sums: WindowSums) -> tuple[Array, Array]:
    """Coefficients (m, 3) on u from the regression of a whole window on u and du/dt, and its residual variance (3,)."""
    m = sums.reference_channels
    part = factor(sums, derivative=True)
    slopes, *_ = np.linalg.lstsq(part.r[1:, 1:], part.rhs[1:], rcond=UNSEEN)
    variance = np.diag(part.residual) / max(part.count - 2 * m - 1, 1.0)
    power = np.diag(part.rhs.T @ part.rhs) / part.count
    return np.asarray(slopes[:m]), np.maximum(variance, NOISE_FLOOR**2 * power.max())
