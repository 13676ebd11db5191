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

from calib.excitation.lag_search import largest_omega
from calib.model import Array, Window, WindowSums, own_channels
from calib.windows.excited import NOISE_LEFT
from calib.windows.sums import NOISE_FLOOR, factor, pool

LEAST_SEGMENTS = 6  # two unknowns, and four degrees of freedom for the scatter
SIGNIFICANT = 5.0  # standard uncertainties; to correct a smaller drift would improve nothing
UNSEEN = 1e-6  # relative to the strongest direction of motion: weaker directions are rounding errors
LEAST_RATE = 1e-6  # clocks fitted to stamps of one gateway differ by 0.2 ppm, two quartz clocks by several ppm


@dataclass(frozen=True, slots=True)
class LagDrift:
    """Lag over time: `lag_s` at `time_s`; it changes by `rate` (s/s), whose standard uncertainty is `u_rate`.

    `phase_rad`: the largest phase of the motion that a lag on this line is, or, if that is larger, the scatter of the
    lags about it beyond their noise. What is told of the lag is of first order in it.
    """

    time_s: float
    lag_s: float
    rate: float
    u_rate: float
    phase_rad: float

    @property
    def significant(self) -> bool:
        """Whether the data show that the two clocks run apart."""
        return abs(self.rate) > max(SIGNIFICANT * self.u_rate, LEAST_RATE)

    @property
    def improves(self) -> bool:
        """Whether clocks that run apart, and were corrected before, run apart less after this is corrected as well."""
        return abs(self.rate) > self.u_rate


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
    beyond_noise_s = float(np.sqrt(max(scatter - 1.0, 0.0) * len(lag_s) / weight.sum()))
    furthest_s = float(np.abs(line[0] + line[1] * (np.array([time_s.min(), time_s.max()]) - middle)).max())
    phase_rad = largest_omega([w for w, _ in told]) * max(furthest_s, beyond_noise_s)
    u_rate = float(np.sqrt(inverse[1, 1] * max(scatter, 1.0)))
    return LagDrift(middle, float(line[0]), float(line[1]), u_rate, phase_rad)


def u_common_lag_s(window: Window) -> float:
    """The standard uncertainty in s of the lag that all segments of a window share: what u tells of du/dt, the window's
    sensitivities may tell of V in the place of a lag. inf where noise alone is left of du/dt.
    """
    whole, m = pool(window.sums), window.sums.reference_channels
    power, own = whole.scatter[0], own_channels(m)
    direct, noise = _of_window(window.sums)
    direct, rates = direct[:own], slice(m, m + own)
    shared = np.linalg.pinv(power[:m, :m], rcond=UNSEEN, hermitian=True) @ power[:m, rates]
    left = power[rates, rates] - power[rates, :m] @ shared
    if window.reference_noise is not None:
        of_u, of_rate = whole.count[0] * window.reference_noise**2
        left_by_noise = np.diag(of_rate) + shared[:own].T @ (of_u[:, None] * shared[:own])
        left = left - (1.0 + NOISE_LEFT) * left_by_noise
    told = np.maximum(np.einsum("ji,jk,ki->i", direct, left, direct), 0.0)
    return float(np.sqrt(told @ noise) / told.sum()) if told.any() else np.inf


def segment_lags(window: Window) -> Array:
    """(K, 3) for each segment of a window: its middle, the lag, and u(lag) for white noise, all in s.

    b (m, 3) are the sensitivities of the whole window; each segment then has one unknown: V - b'u = -lag b'du/dt. A
    segment without motion has no row.
    """
    sums = window.sums
    m, own = sums.reference_channels, own_channels(sums.reference_channels)
    direct, noise = _of_window(sums)
    u, du, out = slice(0, m), slice(m, m + own), slice(2 * m, 2 * m + 3)
    moves = direct[:own]
    power = np.einsum("ji,kjl,li->ki", moves, sums.scatter[:, du, du], moves)  # of b'du/dt, (K, 3)
    common = np.einsum("ji,kji->ki", moves, sums.scatter[:, du, out] - sums.scatter[:, du, u] @ direct)
    size = power.sum(axis=1)
    told = size > 0.0
    ends = np.cumsum(sums.count)
    middle = window.start_s + (ends - 0.5 * sums.count) / ends[-1] * (window.stop_s - window.start_s)
    lag = -common.sum(axis=1)[told] / size[told]
    return np.column_stack([middle[told], lag, np.sqrt(power[told] @ noise) / size[told]])


def _of_window(sums: WindowSums) -> tuple[Array, Array]:
    """Coefficients (m, 3) on u from the regression of a whole window on u and du/dt, and its residual variance (3,).

    Integrals of an AC-coupled reference belong to u; their derivative is u once more, and is left out.
    """
    m = sums.reference_channels
    part = factor(sums, derivative=True)
    slopes, *_ = np.linalg.lstsq(part.r[1:, 1 : 1 + m + own_channels(m)], part.rhs[1:], rcond=UNSEEN)
    variance = np.diag(part.residual) / max(part.count - 2 * m - 1, 1.0)
    power = np.diag(part.rhs.T @ part.rhs) / part.count
    return np.asarray(slopes[:m]), np.maximum(variance, NOISE_FLOOR**2 * power.max())
