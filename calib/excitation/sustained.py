"""The band of the motion that lasts, where shocks of other frequencies come and go beside it: traffic on a bridge.

Sensor and reference do not respond alike at all frequencies. Where the strong motion is at other frequencies than the
rest, a response looks like an output that is not proportional to the motion. Within the band of the sustained motion
the strong and the weak motion have the same frequencies, so that this can be told apart.
"""

from __future__ import annotations

import itertools

import numpy as np

from calib.model import Array
from calib.signal.band import hanning
from calib.signal.order_statistics import median

SEGMENT_S = 2.0  # of a spectrum: a shock of an axle is shorter
LEAST_SEGMENTS = 8
BANDS_AN_OCTAVE, FEWEST_LINES = 3, 4
HOLDS = 1e-3  # of the sustained power: a band that holds less of it is beside the motion
OVER_FLOOR = 4.0  # times the lowest density of all bands: less may be noise of the reference
# The median over segments of Gaussian motion in four lines of three channels is 0.97 of the mean, of one channel 0.92.
COMES_AND_GOES = 4.0  # times the median: a mean beyond it is of a few segments
MATTERS = 1e-2  # of the power: shocks beyond the sustained band that hold less of it move no slope
BESIDE = 1.1  # times the highest band that lasts: where both signals are limited


def sustained_hz(u: Array, rate_hz: float) -> float | None:
    """Up to which frequency in Hz the motion u (n, m) in m/s2 lasts; None where no shocks are beyond, or u is short."""
    size = int(SEGMENT_S * rate_hz)
    count = len(u) // size
    if count < LEAST_SEGMENTS or size < 2 * FEWEST_LINES:
        return None
    parts = u[: count * size].reshape(count, size, -1)
    lines = np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * hanning(size)[:, None], axis=1)
    power = np.sum(lines.real**2 + lines.imag**2, axis=2)[:, 1:-1]
    edges = _edges(power.shape[1])
    each = np.stack([power[:, a:b].sum(axis=1) for a, b in itertools.pairwise(edges)])  # (bands, segments)
    lasting, mean, width = median(each), each.mean(axis=1), np.diff(edges)
    floor = float((lasting / width).min())
    lasts = (lasting > HOLDS * lasting.sum()) & (lasting > OVER_FLOOR * floor * width)
    if not lasts.any():
        return None
    end = int(np.flatnonzero(lasts)[-1]) + 1
    shocks = mean[end:][mean[end:] > COMES_AND_GOES * lasting[end:]].sum()
    return BESIDE * edges[end] * rate_hz / size if shocks > MATTERS * mean.sum() else None


def _edges(lines: int) -> list[int]:
    """Numbers of the lines at which bands begin, and the number of lines."""
    starts = [0]
    for k in range(1, lines):
        if k - starts[-1] >= FEWEST_LINES and (k + 1) >= (starts[-1] + 1) * 2.0 ** (1.0 / BANDS_AN_OCTAVE):
            starts.append(k)
    return [*starts, lines]
