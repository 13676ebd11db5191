"""How far the sensor lags behind the reference in the course of a recording: two clocks that nobody disciplined drift.

Stamps of a recorder's own clock are a perfect grid and still 10 to 50 ppm off; a minute of that is a millisecond. The
lag shows in every segment of motion as the coefficient on the reference's derivative, V(t) = S a(t - lag).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.excitation.sums import NOISE_FLOOR, factor
from calib.model import Array, Window, WindowSums

LEAST_SEGMENTS = 6  # two unknowns, and a scatter of some weight
SIGNIFICANT = 5.0  # standard uncertainties: else nothing is gained by taking the drift out
UNSEEN = 1e-6  # of the strongest direction of motion: weaker ones are rounding
LEAST_RATE = 1e-6  # clocks fitted to the same gateway's stamps leave 0.2 ppm, quartz of its own is some ppm off


@dataclass(frozen=True, slots=True)
class Drift:
    """Lag over time: `lag_s` at `time_s`, changing by `rate` seconds a second; `u_rate` its standard uncertainty."""

    time_s: float
    lag_s: float
    rate: float
    u_rate: float

    @property
    def significant(self) -> bool:
        """Whether the two clocks run apart, as far as the data tell."""
        return abs(self.rate) > max(SIGNIFICANT * self.u_rate, LEAST_RATE)


def drift(windows: Sequence[Window]) -> Drift | None:
    """The straight line through the lags of all segments of used motion; None where there are too few."""
    moving = [w for w in windows if w.used and w.kind == "motion"]
    found = [part for part in map(segment_lags, moving) if len(part)]
    lags = np.concatenate(found) if found else np.empty((0, 3))
    if len(lags) < LEAST_SEGMENTS:
        return None
    time_s, lag_s, u_s = lags.T
    weight = 1.0 / u_s**2
    middle = float(weight @ time_s / weight.sum())
    design = np.column_stack([np.ones(len(lags)), time_s - middle])
    inverse = np.linalg.inv(design.T @ (weight[:, None] * design))
    line = inverse @ (design.T @ (weight * lag_s))
    scatter = float(weight @ (lag_s - design @ line) ** 2) / (len(lags) - 2)
    return Drift(middle, float(line[0]), float(line[1]), float(np.sqrt(inverse[1, 1] * max(scatter, 1.0))))


def segment_lags(window: Window) -> Array:
    """(K, 3) for each segment of motion: its middle, the lag, and the lag's standard uncertainty (white noise), in s.

    With the sensitivities b of the whole window (m, 3), a segment has one unknown: V - b'u = -lag b'du/dt. A window
    that does not move has none.
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
    """Coefficients (m, 3) on u beside its derivative, and the variance (3,) of what both leave, of a whole window."""
    m = sums.reference_channels
    part = factor(sums, derivative=True)
    slopes, *_ = np.linalg.lstsq(part.r[1:, 1:], part.rhs[1:], rcond=UNSEEN)
    variance = np.diag(part.residual) / max(part.count - 2 * m - 1, 1.0)
    power = np.diag(part.rhs.T @ part.rhs) / part.count
    return np.asarray(slopes[:m]), np.maximum(variance, NOISE_FLOOR**2 * power.max())
