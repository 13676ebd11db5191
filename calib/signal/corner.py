"""Correction for the first-order high-pass filter of an AC-coupled instrument.

The inverse of the filter is exact: true = x + c * integral of x, with the corner c in rad/s. A corner of 0.16 Hz that
is left uncorrected causes an error of 0.56 % between 0.5 and 8 Hz. A lag cannot describe it: the filter's output leads,
and by less time at higher frequencies. If the corner is to be estimated from the data, the windows hold the integral of
the recorded signal (before any correction) as further channels behind the reference's own. The window equations are
then exact, whatever corner was corrected before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.model import Array, Pose
from calib.signal.band import hanning

BELOW = 1e-2  # of the power of motion, that is slower than where it begins
SLOWER = 0.5  # times the frequency at which the motion begins: what is slower is noise
BLOCKS, FEWEST_BLOCKS = 240, 16  # of samples whose integral has a straight line; with fewer all count alike
TURNS = 40  # of the weights
OF_MEDIAN = 3.5  # times the median of what is left: where a weight is a half. Of normal noise 95 % of all tells then
CYCLES = 30  # of the slowest motion, in a stretch: with fewer, it cannot be told from what is slower


def integral(x: Array, rate_hz: float, from_hz: float = 0.0) -> Array:
    """2 pi times the time integral of samples x (n, m) in m/s2; the result is in m/s2 s and as large as x at 1 Hz.

    Each stretch between missing samples (NaN) is integrated by itself; the result is NaN where samples are missing. The
    constant of integration does not matter, because a window has a constant of its own. Mean and linear trend are
    removed: otherwise the zero error of the instrument would make the integral grow without limit. So is what is slower
    than `from_hz`.
    """
    out = np.full(x.shape, np.nan)
    for first, stop in _stretches(x):
        out[first:stop] = _without_slower(_integral(x[first:stop], rate_hz), rate_hz, from_hz)
    return out


def integral_of_motion(x: Array, rate_hz: float) -> Array:
    """The integral of samples x (n, m) of an instrument at the frequencies of its motion.

    Below them it is the integral of the instrument's noise, which grows towards low frequencies. Were it a regressor,
    the corner, by which noise and its integral go together, would be found too low.
    """
    longest = max(_stretches(x), key=lambda ends: ends[1] - ends[0], default=(0, 0))
    return integral(x, rate_hz, SLOWER * _begins_hz(x[slice(*longest)], rate_hz))


def _stretches(x: Array) -> list[tuple[int, int]]:
    """[first, stop) of each stretch of x (n, m) without a missing sample."""
    whole = np.isfinite(x).all(axis=1)
    edges = np.flatnonzero(np.diff(whole.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    return [(first, stop) for first, stop in edges.tolist()]


def _begins_hz(x: Array, rate_hz: float) -> float:
    """The frequency below which x (n, m) has less than the share BELOW of its power; 0 where that is a few cycles."""
    if len(x) < 2:
        return 0.0
    power = np.sum(np.abs(np.fft.rfft((x - x.mean(axis=0)) * hanning(len(x))[:, None], axis=0)) ** 2, axis=1)
    line = int(np.searchsorted(np.cumsum(power), BELOW * power.sum()))
    return line * rate_hz / len(x) if line >= CYCLES else 0.0


def _without_slower(x: Array, rate_hz: float, from_hz: float) -> Array:
    """x (n, m) without what is slower than `from_hz`, by its cosine transform, which needs no samples beyond it."""
    if not from_hz:
        return x
    lines = np.fft.rfft(np.concatenate([x, x[::-1]]), axis=0)
    lines[: int(np.ceil(2.0 * len(x) * from_hz / rate_hz))] = 0.0
    return np.asarray(np.fft.irfft(lines, 2 * len(x), axis=0)[: len(x)])


def _integral(x: Array, rate_hz: float) -> Array:
    rising = (np.cumsum(x, axis=0) - 0.5 * x) / rate_hz
    return np.asarray(2.0 * np.pi * (rising - _straight(rising)))


def _straight(x: Array) -> Array:
    """(n, m) the straight line on which most of x (n, m) lies, by least squares with weights of Cauchy.

    A filtered motion integrates to what comes back to zero within seconds; a zero error to a straight line. Of all
    samples alike, a blow at one end would tilt the line of the quiet minute before it.
    """
    edges = np.unique(np.linspace(0, len(x), min(len(x), BLOCKS) + 1).astype(np.int64))[:-1]
    size = np.diff(np.append(edges, len(x)))
    time, means = edges + 0.5 * (size - 1.0), np.add.reduceat(x, edges, axis=0) / size[:, None]
    unit = max(float(len(x) - 1), 1.0)
    weights, at = np.ones_like(means), (2.0 * time / unit - 1.0)[:, None]
    for _ in range(TURNS):
        total = weights.sum(axis=0)
        middle, mean = (np.sum(weights * own, axis=0) / total for own in (at, means))
        slope = np.sum(weights * (at - middle) * means, axis=0) / np.maximum(
            np.sum(weights * (at - middle) ** 2, axis=0), np.finfo(float).tiny
        )
        left = means - mean - slope * (at - middle)
        scale = OF_MEDIAN * np.median(np.abs(left), axis=0)
        if len(means) < FEWEST_BLOCKS or not scale.any():
            break
        weights = 1.0 / (1.0 + (left / np.where(scale > 0.0, scale, np.inf)) ** 2)
    line = np.linspace(-1.0, 1.0, len(x))[:, None]
    return np.asarray(mean + slope * (line - middle))


def without_corner(x: Array, rate_hz: float, corner_hz: float) -> Array:
    """Samples x (n, m) of a whole recording as they were before a high-pass filter with the corner `corner_hz`."""
    return x + corner_hz * integral(x, rate_hz) if corner_hz else x


def with_integral(pose: Pose) -> Pose:
    """The pose for windows whose channels are those of the reference followed by their integrals.

    The columns of the integrals in `direction` are zero: they act only through an error of the corner.
    """
    return replace(pose, direction=np.hstack([pose.direction, np.zeros_like(pose.direction)]))
