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
FEW_KNOCKS = 0.01  # of the points: below, nobody asks whether the residual grows with the motion
LEVELS, FEWEST_A_LEVEL = 10, 50  # groups of points with as much motion, and points in each
NEARBY = 51  # points over which the level of the motion is averaged
GROWS = 2.0  # times: knocks that have nothing to do with the motion leave the medians of the groups alike
# Least eigenvalue of the matrix of the columns' cosines: above it the normal equations are accurate to 1e-10, and ten
# times as fast as a factorisation.
INDEPENDENT = 1e-6
SLOW_BAND_HZ = 50.0  # first band tried for the motion; it is widened until it holds most of the motion's power
MOST_POWER = 0.7  # part of the motion's power
SPECTRUM_SAMPLES, SPECTRA, FEWEST_FOR_SPECTRUM = 4096, 4, 16
HANN_LINES = 2.0 / 3.0  # of the lines of a Hann window are independent
LINES_TOGETHER = 16  # lines of a spectrum in which sensor and reference are related by one complex matrix
RELATED = 1e-9  # relative eigenvalue of the sensor's channels below which they show nothing more
# Least sensitivity of an axis over that of another one: a direction with less of it shows the noise of a reference that
# does not move there, not a sensitivity.
ALIKE = 0.3
CLEAR = 6.0  # standard deviations of what independent noise shows by chance
CLIPPED_POINTS = 3  # fewer points with the same extreme value may occur by chance
NEAR_END = 0.1  # of the range: values near its end
DISTINCT = 0.99  # if this part of the points within the range differ, three points at an extreme are no chance
ROUNDING = 1e-9  # of the range: smaller residuals are rounding errors, not noise


def moving(u: Array, rate_hz: float, noise: Array) -> list[Stretch]:
    """Stretches in which the reference u (n, m) moves: its level is high enough compared with its strongest part.

    `noise` (m,) is the SD of its white noise (`white_noise`).
    """
    width = band_width(u, rate_hz, noise)
    slow = averaged(u - median(u.T), width) if len(u) else u
    size = max(1, round(FRAME_S * rate_hz / width))
    frames = len(slow) // size
    if frames < 2:
        return [(0, len(u))] if len(u) else []
    level = np.sqrt(np.mean(slow[: frames * size].reshape(frames, -1) ** 2, axis=1))
    on = level > MOVING_LEVEL * quantile(level, 0.9)
    return _stretches(_bridged(on, round(BRIDGE_S / FRAME_S)), size * width, len(u))


def half_period_s(x: Array, rate_hz: float) -> float:
    """Time between two changes of sign of the strongest channel of x (n, m), on average; inf where there is none."""
    strongest = x[:, int(np.argmax(np.var(x, axis=0)))]
    slow = averaged(strongest[:, None], max(1, round(FRAME_S * rate_hz)))[:, 0]
    changes = np.count_nonzero(np.diff(np.signbit(slow - slow.mean()))) if len(slow) else 0
    return len(x) / rate_hz / changes if changes else np.inf


def knocked(V: Array, basis: Array, finest: Array) -> tuple[Mask, Array]:
    """Flags (n,) of knocks: points whose residual from the regression of V (n, 3) on `basis` (n, p) is above five
    robust SDs; and the residuals (n, 3) of all points from the regression of the other points.

    `finest` (3,) is the resolution of V (`least_step`). Where many points are beyond the limit, and the residual grows
    with the motion in `basis`, the robust SD is that of points with as much motion: such a residual is the model's (a
    lever arm, a loose mount), not a knock.
    """
    columns, outputs = np.ascontiguousarray(basis.T), np.ascontiguousarray(V.T)
    struck, residual = _beyond(columns, outputs, finest, np.ones(len(V)))
    if len(V) >= LEVELS * FEWEST_A_LEVEL and struck.mean() > FEW_KNOCKS:
        growth = _growth(columns[1:], residual)
        if growth.max() > GROWS * growth.min():
            struck, residual = _beyond(columns, outputs, finest, growth / growth.min())
    return struck, residual.T


def _beyond(columns: Array, outputs: Array, finest: Array, growth: Array) -> tuple[Mask, Array]:
    """Flags (n,) of points beyond five robust SDs, times `growth` (n,), and the residuals (3, n)."""
    struck: Mask = np.zeros(outputs.shape[1], dtype=bool)
    steady = bool(growth.max() <= 1.0)
    for _ in range(KNOCK_PASSES):
        kept = np.flatnonzero(~struck) if struck.any() else slice(None)
        residual = outputs - regression(columns[:, kept], outputs[:, kept]) @ columns
        away = np.abs(residual) if steady else np.abs(residual) / growth
        if not struck.any() and _is_calm(away):
            break
        limit = KNOCK_SD * np.maximum(1.4826 * median(away[:, kept]), 0.5 * finest)
        now = np.asarray((away > limit[:, None]).any(axis=0))
        if np.array_equal(now, struck):
            break
        struck = now
    return struck, residual


def _is_calm(away: Array) -> bool:
    """Whether no value of `away` (3, n) is beyond the limit for knocks, whatever the resolution is.

    The limit is above the largest value if the median is `needed` or more, and then more than half of the values are.
    To count them takes a tenth of the time of a median.
    """
    needed = away.max(axis=1) / (KNOCK_SD * 1.4826) * (1.0 + 1e-12)  # the products are rounded
    return bool((2 * np.count_nonzero(away >= needed[:, None], axis=1) > away.shape[1] + 1).all())


def _growth(motion: Array, residual: Array) -> Array:
    """How the size of the residual (3, n) grows with the level of the `motion` (p, n) nearby: its median in LEVELS
    groups of points with as much motion, of the axis where it grows most; it never falls."""
    centred = motion - motion.mean(axis=1, keepdims=True)
    unit = np.sqrt(np.mean(centred**2, axis=1, keepdims=True))
    level = np.sum(np.divide(centred, unit, out=np.zeros_like(centred), where=unit > 0.0) ** 2, axis=0)
    level = np.convolve(level, np.ones(NEARBY), "same")
    groups = np.array_split(np.argsort(level, kind="stable"), LEVELS)
    sizes = np.array([median(np.abs(residual[:, group])) for group in groups])
    rising = np.maximum.accumulate(sizes / np.maximum(sizes.min(axis=0), np.finfo(float).tiny), axis=0)
    growth = np.empty(len(level))
    for group, size in zip(groups, rising[:, int(np.argmax(rising[-1]))], strict=True):
        growth[group] = size
    return growth


def regression(columns: Array, outputs: Array) -> Array:
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

    `residual` (n, 3) of V from its regression on the motion, `finest` (3,) the resolution of V. The motion goes beyond
    what it does at other values near the extreme one: a lag or a response makes all large values too small.
    """
    points = 0
    for axis in range(V.shape[1]):
        v, r = V[:, axis], residual[:, axis]
        for end, sign in ((v.max(), 1.0), (v.min(), -1.0)):
            held = np.flatnonzero(v == end)
            if len(held) < CLIPPED_POINTS:
                continue
            noise = 1.4826 * float(median(np.abs(r)))
            near = (sign * (end - v) < NEAR_END * np.ptp(v)) & (v != end)
            inwards = max(-sign * float(r[near].mean()), 0.0) if near.any() else 0.0
            if _all_differ(v, noise) or -sign * float(r[held].mean()) > inwards + noise + finest[axis]:
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
    parts, window = spectral_parts(x)
    if parts is None:
        return np.zeros(x.shape[1])
    lines = np.fft.rfft((parts - parts.mean(axis=2, keepdims=True)) * window)[..., 1:-1]
    power = median((lines.real**2 + lines.imag**2).reshape(len(lines), -1)) / np.sum(window**2)
    # The power of a line of white noise is exponentially distributed: its mean is its median divided by ln 2.
    return np.asarray(np.sqrt(power / np.log(2.0)))


def moving_share(u: Array, V: Array, rate_hz: float, band_hz: tuple[float, float], derivatives: int) -> Array:
    """How much (m,) of the power of a reference u (n, m) between two frequencies is motion: the sensor's V (n, 3) shows
    it as well, with the sensitivity that it has for the whole motion, at any lag. From 0 to 1; 0 where it is not clear.
    The quieter half of the frequencies counts.

    `derivatives`: how often the measured quantity was differentiated to give u; the power is that of the quantity.
    """
    m, (parts, window) = u.shape[1], spectral_parts(np.hstack([u, V]))
    if parts is None:
        return np.zeros(m)
    at_hz = np.arange(parts.shape[2] // 2 + 1) * (rate_hz / parts.shape[2])
    within = np.flatnonzero((at_hz >= band_hz[0]) & (at_hz <= band_hz[1]) & (at_hz > 0.0))
    if len(within) < LINES_TOGETHER:
        return np.zeros(m)
    lines = np.fft.rfft((parts - parts.mean(axis=2, keepdims=True)) * window)[..., within]
    rows = _in_groups(lines / at_hz[within] ** derivatives)
    moved, shown = u - u.mean(axis=0), V - V.mean(axis=0)
    back = np.linalg.pinv(np.linalg.pinv(moved.T @ moved, hermitian=True) @ (moved.T @ shown), ALIKE)
    own, seen = np.split(np.mean(np.abs(rows) ** 2, axis=2), [m], axis=1)
    both = np.abs(np.einsum("gjl,gil,ij->gj", rows[:, :m].conj(), rows[:, m:], back)) / rows.shape[2]
    # Of independent noise, the square of a mean product is that of both powers over the number of independent lines.
    chance = own * (seen @ back**2) / (HANN_LINES * LINES_TOGETHER * min(parts.shape[1], len(u) / parts.shape[2]))
    quiet = own <= np.median(own, axis=0)  # the floor: what else is there may be a line, or the ends of a turn
    told, power = np.sum(both**2 - chance, axis=0, where=quiet), np.sum(own**2, axis=0, where=quiet)
    clear = told > CLEAR * np.sqrt(np.sum(chance**2, axis=0, where=quiet))
    share = np.divide(told, power, out=np.zeros(m), where=clear & (power > 0.0))
    return np.asarray(np.sqrt(np.clip(share, 0.0, 1.0)))


def incoherent(u: Array, V: Array) -> Array:
    """SD (m,) of what of the reference u (n, m) the sensor's V (n, 3) does not show at any lag; inf if both are too
    short. No noise of the reference is larger.

    A motion that fills the spectrum looks like white noise (`white_noise`), but the sensor shows it as well.
    """
    told = incoherent_by_band(u, V)
    return np.full(u.shape[1], np.inf) if told is None else np.sqrt(np.maximum(told[0].sum(axis=0), 0.0))


def incoherent_by_band(u: Array, V: Array) -> tuple[Array, Array] | None:
    """Variance (G, m) of what of the reference u (n, m) the sensor's V (n, 3) does not show at any lag, and of u, in G
    bands of one width from 0 to half the sampling rate; None if both are too short."""
    parts, window = spectral_parts(np.hstack([u, V]))
    if parts is None or parts.shape[2] < 4 * LINES_TOGETHER:
        return None
    m, lines = u.shape[1], np.fft.rfft((parts - parts.mean(axis=2, keepdims=True)) * window)[..., 1:-1]
    rows = _in_groups(lines)
    cross = rows @ rows.conj().transpose(0, 2, 1)
    own, seen, both = cross[:, :m, :m], cross[:, m:, m:], cross[:, :m, m:]
    left = own - both @ np.linalg.pinv(seen, RELATED, hermitian=True) @ both.conj().transpose(0, 2, 1)
    # Neighbouring lines of a Hann window, and segments that overlap, tell less than as many independent ones.
    independent = HANN_LINES * LINES_TOGETHER * min(parts.shape[1], len(u) / parts.shape[2])
    # The variance of a channel is the sum of its lines on both sides of the spectrum.
    size, segments = 2 * (lines.shape[2] + 1), parts.shape[1]
    unit = 2.0 / (segments * size * np.sum(window**2))
    power, alone = (unit * np.diagonal(of, axis1=1, axis2=2).real for of in (own, left))
    return np.asarray(independent / (independent - V.shape[1]) * alone), np.asarray(power)


def _in_groups(lines: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """(G, m, -1) of each group of LINES_TOGETHER neighbours among lines (m, parts, k) all that a channel has."""
    groups = lines.shape[2] // LINES_TOGETHER
    together = lines[..., : groups * LINES_TOGETHER].reshape(len(lines), -1, groups, LINES_TOGETHER)
    return together.transpose(2, 0, 1, 3).reshape(groups, len(lines), -1)


def spectral_parts(x: Array) -> tuple[Array | None, Array]:
    """Segments (m, SPECTRA, size) of x (n, m), spread over it, and their window (size,); None if x is too short."""
    size = min(SPECTRUM_SAMPLES, 1 << max(len(x).bit_length() - 1, 0))
    if size < FEWEST_FOR_SPECTRUM:
        return None, np.zeros(0)
    starts = sorted({k * (len(x) - size) // (SPECTRA - 1) for k in range(SPECTRA)})
    rows = np.ascontiguousarray(x.T)
    return np.stack([rows[:, k : k + size] for k in starts], axis=1), hanning(size)


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
