"""When a drift or a step began, how large it is now and how fast: a broken line through the history of a parameter.

    y_i = a + b h(t_i - t0) + e_i,    h(t) = max(t, 0) of a drift, 1 for t >= 0 of a step

For each supposed t0 the line is fitted by least squares. Its sum of squares S(t0) gives the probability of t0, as even
beforehand and with the variance of e unknown: S^(-m / 2) (as D. Holbert, Bayesian inference related to shifting
sequences and two-phase regression, thesis, Oklahoma State University 1973, has it for two lines). The e are not
independent, since a calibration continues the one before. If neighbours of the residuals have the correlation r, n of
them count as m = n (1 - r) / (1 + r). The u of the values play no part: most of it is of the reference and the same in
all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

POINTS_MIN = 8  # of the history: three unknowns and the scatter
AFTER_MIN = 3  # points after the change
SUPPOSED = 400  # times that are tried
CLEAR = 3.0  # standard uncertainties of the size from which there is a change
LARGEST_CORRELATION = 0.95

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Since:
    """A change that began on `day`: its size until the last point and rate a day, each with its standard uncertainty.

    A step has the rate 0. `squares`: the least sum of squares that it leaves.
    """

    day: float
    u_day: float
    size: float
    u_size: float
    rate: float
    u_rate: float
    squares: float


def since(t_days: Array, values: Array, shape: Literal["drifting", "stepped"]) -> Since | None:
    """The change in values (n,) at the times t_days (n,), which rise. None where the history does not show it."""
    n = len(t_days)
    if n < POINTS_MIN or not t_days[-1] > t_days[0] or not np.ptp(values) > 0:
        return None
    onsets = np.linspace(t_days[0], t_days[-AFTER_MIN], SUPPOSED + 2)[1:-1]
    later = t_days - onsets[:, None]
    bent = np.maximum(later, 0.0) if shape == "drifting" else (later >= 0.0).astype(float)
    bent -= bent.mean(axis=1, keepdims=True)
    centred, spread = values - values.mean(), np.sum(bent**2, axis=1)
    slopes = bent @ centred / spread
    residuals = centred - slopes[:, None] * bent
    squares = np.maximum(np.sum(residuals**2, axis=1), np.finfo(float).tiny)
    factor = _independent(residuals[np.argmin(squares)])
    count = n * factor
    weights = np.exp(-0.5 * count * np.log(squares / squares.min()))
    weights /= weights.sum()
    reach = t_days[-1] - onsets if shape == "drifting" else np.ones(len(onsets))
    variances = squares / (max(count - 3.0, 1.0) * spread / n) / n
    size, u_size = _mixed(slopes * reach, variances * reach**2, weights)
    day, u_day = _mixed(onsets, np.full(len(onsets), (onsets[1] - onsets[0]) ** 2 / 12.0), weights)
    if abs(size) < CLEAR * u_size:
        return None
    rate, u_rate = _mixed(slopes, variances, weights) if shape == "drifting" else (0.0, 0.0)
    return Since(day, u_day, size, u_size, rate, u_rate, float(squares.min()))


def _independent(residuals: Array) -> float:
    """The share of the residuals that counts as independent."""
    r = float(residuals[1:] @ residuals[:-1] / (residuals @ residuals)) if residuals.any() else 0.0
    r = min(max(r, 0.0), LARGEST_CORRELATION)
    return (1.0 - r) / (1.0 + r)


def _mixed(means: Array, variances: Array, weights: Array) -> tuple[float, float]:
    """Mean and standard uncertainty of what has these means and variances with these probabilities."""
    mean = float(weights @ means)
    return mean, float(np.sqrt(weights @ (variances + (means - mean) ** 2)))
