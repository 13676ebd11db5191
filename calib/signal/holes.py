"""Values for holes of one or two samples, from the samples around them and the band of the motion.

A filter spreads a missing sample over its whole length, and resampling over sixteen samples. Where the motion occupies
only a part of the spectrum, the samples around a hole determine what is missing: the weights are those of the least
mean square error for motion of equal power density up to the end of the band, and white noise (Wiener 1949).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.model import Array

SHORT_HOLE = 2  # samples; longer holes stay, because a device that loses more in a row has stopped for that time
AROUND = 16  # samples on each side of a hole that have a weight
# Power of the noise over that of the motion, for which the weights are the best. It is so small that a value misses
# less than 1e-3 of the motion whatever the true ratio is.
NOISE_RATIO = 1e-6
# Mean square error of a value in units of the variance of a sample's own noise. It is 1 where the band is a third of
# the spectrum and the hole is one sample, and rises steeply with the band.
MOST_ERROR = 4.0
CHUNK = 256  # holes whose equations are solved together: 2 MB

Mask = NDArray[np.bool_]


def in_short_holes(missing: Mask) -> Mask:
    """Which of the `missing` samples (n,) lie in holes of at most SHORT_HOLE samples."""
    short = missing.copy()
    edges = np.flatnonzero(np.diff(missing.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    for first, stop in edges[edges[:, 1] - edges[:, 0] > SHORT_HOLE].tolist():
        short[first:stop] = False
    return short


def short_holes_filled(x: Array, rate_hz: float, band_hz: float) -> tuple[Array, Mask]:
    """x (n, k) with its short holes filled, and which rows (n,) were filled; `x` itself if no row was.

    A row of x with NaN is a missing sample. All motion in x must be below `band_hz`; a constant may be added to it. A
    hole stays where the samples around it do not determine it (MOST_ERROR): near the ends of x, near long holes, and
    everywhere if the band is too wide for this.
    """
    missing: Mask = np.asarray(np.isnan(x).any(axis=1))
    filled = np.zeros(len(x), dtype=bool)
    holes = np.flatnonzero(in_short_holes(missing))
    if not len(holes):
        return x, filled
    out, offset = x.copy(), np.delete(np.arange(-AROUND, AROUND + 1), AROUND)
    width = 2.0 * band_hz / rate_hz
    covariance = np.sinc(width * (offset[:, None] - offset)) + NOISE_RATIO * np.eye(len(offset))
    padded = np.pad(np.where(missing[:, None], np.nan, x), ((AROUND, AROUND), (0, 0)), constant_values=np.nan)
    for k in range(0, len(holes), CHUNK):
        rows = holes[k : k + CHUNK]
        values, error = _values(padded[rows[:, None] + AROUND + offset], covariance, np.sinc(width * offset))
        good = error <= MOST_ERROR * NOISE_RATIO
        out[rows[good]], filled[rows[good]] = values[good], True
    return (out, filled) if filled.any() else (x, filled)


def _values(around: Array, covariance: Array, towards: Array) -> tuple[Array, Array]:
    """Values (h, k) of missing samples, and their mean square error (h,) over the power of the motion.

    `around` (h, w, k) are the samples around each, NaN where these are missing too; `covariance` (w, w) of these
    samples, `towards` (w,) with the missing one, both over the power of the motion.
    """
    known: Mask = np.asarray(np.isfinite(around).all(axis=2))
    system = np.where(known[:, :, None] & known[:, None, :], covariance, np.eye(len(towards)))
    right = towards * known
    weights = np.linalg.solve(system, right[:, :, None])
    held = np.where(known[:, :, None], around, 0.0)
    mean = held.sum(axis=1) / np.maximum(known.sum(axis=1), 1)[:, None]
    departure = np.where(known[:, :, None], around - mean[:, None], 0.0)
    return mean + np.sum(weights * departure, axis=1), 1.0 - np.sum(weights[:, :, 0] * right, axis=1)
