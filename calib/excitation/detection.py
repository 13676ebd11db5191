"""Detection of the reference's motion, of knocks and of clipped points (calib.excitation.rests finds rests)."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.signal.band import hanning
from calib.signal.order_statistics import distinct, median, quantile

Mask = NDArray[np.bool_]
Stretch = tuple[int, int]  # [first, stop) of samples

FRAME_S = 0.25  # time resolution of the begin and end of motion; three quarters of a cycle at 3 Hz
BRIDGE_S = 1.0  # a shorter pause does not end a stretch of motion
# Relative to the level that a tenth of the frames exceed: slow parts of a random motion are above it, pauses below.
MOVING_LEVEL = 0.4
KNOCK_SD = 5.0  # robust SDs: white noise exceeds them at one point in 1.7 million
KNOCK_PASSES = 8
# Least eigenvalue of the matrix of the columns' cosines: above it the normal equations are accurate to 1e-10, and ten
# times as fast as a factorisation.
INDEPENDENT = 1e-6
SLOW_BAND_HZ = 50.0  # first band tried for the motion; it is widened until it holds most of the motion's power
MOST_POWER = 0.7  # part of the motion's power
SPECTRUM_SAMPLES, SPECTRA, FEWEST_FOR_SPECTRUM = 4096, 4, 16
CLIPPED_POINTS = 3  # fewer points with the same extreme value may occur by chance
DISTINCT = 0.99  # if this part of the points within the range differ, three points at an extreme are no chance
ROUNDING = 1e-9  # of the range: smaller residuals are rounding errors, not noise


def moving(u: Array, rate_hz: float) -> list[Stretch]:
    """Stretches in which the reference u (n, m) moves: its level is high enough compared with its strongest part."""
    width = band_width(u, rate_hz, white_noise(u))
    slow = averaged(u - median(u.T), width) if len(u) else u
    size = max(1, round(FRAME_S * rate_hz / width))
    frames = len(slow) // size
    if frames < 2:
        return [(0, len(u))] if len(u) else []
    level = np.sqrt(np.mean(slow[: frames * size].reshape(frames, -1) ** 2, axis=1))
    on = level > MOVING_LEVEL * quantile(level, 0.9)
    return _stretches(_bridged(on, round(BRIDGE_S / FRAME_S)), size * width, len(u))


def knocked(V: Array, basis: Array, finest: Array) -> tuple[Mask, Array]:
    """Flags (n,) of knocks: points whose residual from the regression of V (n, 3) on `basis` (n, p) is above five
    robust SDs; and the residuals (n, 3) of all points from the regression of the other points.

    `finest` (3,) is the resolution of V (`least_step`).
    """
    columns, outputs = np.ascontiguousarray(basis.T), np.ascontiguousarray(V.T)
    struck: Mask = np.zeros(len(V), dtype=bool)
    for _ in range(KNOCK_PASSES):
        kept = np.flatnonzero(~struck) if struck.any() else slice(None)
        residual = outputs - _regression(columns[:, kept], outputs[:, kept]) @ columns
        away = np.abs(residual)
        limit = KNOCK_SD * np.maximum(1.4826 * median(away[:, kept]), 0.5 * finest)
        now = np.asarray((away > limit[:, None]).any(axis=0))
        if np.array_equal(now, struck):
            break
        struck = now
    return struck, residual.T


def _regression(columns: Array, outputs: Array) -> Array:
    """(3, p) least squares of outputs (3, n) on columns (p, n).

    By normal equations, or by a factorisation if the columns are almost dependent (see INDEPENDENT).
    """
    norm = np.linalg.norm(columns, axis=1)
    norm[norm == 0.0] = 1.0
    gram = columns @ columns.T / np.outer(norm, norm)
    if np.linalg.eigvalsh(gram)[0] > INDEPENDENT:
        return np.asarray(np.linalg.solve(gram, columns @ outputs.T / norm[:, None]).T / norm)
    solution, *_ = np.linalg.lstsq(columns.T, outputs.T, rcond=None)
    return np.asarray(solution.T)


def may_be_clipped(V: Array) -> bool:
    """Whether an axis of V (n, 3) has so many points at an extreme value that `clipped` must look at them."""
    ends = np.stack([V.max(axis=0), V.min(axis=0)])
    return bool(((ends[:, None] == V).sum(axis=1) >= CLIPPED_POINTS).any())


def clipped(V: Array, residual: Array, finest: Array) -> int:
    """Number of points of V (n, 3) that are clipped: several points have the same extreme value, and either the motion
    goes beyond that value, or hardly any two points within the range have the same value.

    `residual` (n, 3) of V from its regression on the motion, `finest` (3,) the resolution of V.
    """
    points = 0
    for axis in range(V.shape[1]):
        v, r = V[:, axis], residual[:, axis]
        for end, sign in ((v.max(), 1.0), (v.min(), -1.0)):
            held = np.flatnonzero(v == end)
            if len(held) < CLIPPED_POINTS:
                continue
            noise = 1.4826 * float(median(np.abs(r)))
            if _all_differ(v, noise) or -sign * float(r[held].mean()) > noise + finest[axis]:
                points += len(held)
    return points


def _all_differ(v: Array, noise: float) -> bool:
    """Whether the resolution of v (n,) is so fine that points within its range hardly ever have the same value."""
    inside = v[(v > v.min()) & (v < v.max())]
    return noise > ROUNDING * float(np.ptp(v)) and len(distinct(inside)) >= DISTINCT * len(inside) > 0


def band_width(u: Array, rate_hz: float, noise: Array) -> int:
    """Number of samples of u (n, m) that can be averaged, to reduce noise, without losing most of the motion's power.

    `noise` (m,) is the SD of its white noise (`white_noise`).
    """
    power = _power(u) - float(np.sum(noise**2)) if len(u) else 0.0
    width = max(1, min(int(rate_hz / SLOW_BAND_HZ), len(u)))
    while width > 1 and _power(averaged(u, width)) < MOST_POWER * power:
        width //= 2
    return width


def averaged(x: Array, width: int) -> Array:
    """Means of each `width` consecutive samples of x (n, m); an incomplete group at the end is dropped."""
    n = len(x) // width
    # One channel per row: numpy adds contiguous values several times faster.
    rows = np.ascontiguousarray(x[: n * width].T)
    return np.asarray(rows.reshape(x.shape[1], n, width).mean(axis=2).T)


def _power(x: Array) -> float:
    """Sum of the variances of the channels of x (n, m)."""
    return float(np.sum(np.var(np.ascontiguousarray(x.T), axis=1)))


def white_noise(x: Array) -> Array:
    """SD (m,) of the white noise in x (n, m), from the median of its spectrum.

    Motion does not change the median if it occupies less than half of the spectrum. Zero if x is too short.
    """
    size = min(SPECTRUM_SAMPLES, 1 << max(len(x).bit_length() - 1, 0))
    if size < FEWEST_FOR_SPECTRUM:
        return np.zeros(x.shape[1])
    starts = sorted({k * (len(x) - size) // (SPECTRA - 1) for k in range(SPECTRA)})
    rows, window = np.ascontiguousarray(x.T), hanning(size)
    parts = np.stack([rows[:, k : k + size] for k in starts], axis=1)
    lines = np.fft.rfft((parts - parts.mean(axis=2, keepdims=True)) * window)[..., 1:-1]
    power = median((lines.real**2 + lines.imag**2).reshape(len(rows), -1)) / np.sum(window**2)
    # The power of a line of white noise is exponentially distributed: its mean is its median divided by ln 2.
    return np.asarray(np.sqrt(power / np.log(2.0)))


def least_step(V: Array) -> Array:
    """(3,) the smallest change between neighbouring samples: the resolution of V if V is in counts, else almost 0."""
    steps = np.abs(np.diff(V, axis=0))
    least = np.min(steps, axis=0, where=steps > 0, initial=np.inf)
    return np.where(np.isfinite(least), least, 0.0)


def _bridged(on: Mask, longest: int) -> Mask:
    """The flags with each pause shorter than `longest` frames between two moving frames set to moving."""
    out = on.copy()
    edges = np.flatnonzero(on)
    for a, b in itertools.pairwise(edges):
        if 1 < b - a <= longest:
            out[a:b] = True
    return out


def _stretches(on: Mask, size: int, n: int) -> list[Stretch]:
    """Stretches of samples from flags of frames; samples after the last whole frame belong to that frame."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(np.int8)))
    pairs = [(int(a) * size, int(b) * size) for a, b in zip(change[::2], change[1::2], strict=True)]
    if pairs and pairs[-1][1] == len(on) * size:
        pairs[-1] = (pairs[-1][0], n)
    return pairs
