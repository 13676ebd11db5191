"""Sums of a window's samples from which the least-squares problem over all its points is solved exactly.

The sums are additive: they are made block by block and merged. For any geometry the input accelerations are linear in
the reference's channels, so the sums need no knowledge of S, Q or the pose. The solution is that of Method 3 over all
points (section 2.3).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.model import Array, WindowSums

# A block of this many samples stays in the second-level cache of a small gateway (8 columns: 256 kB).
BLOCK_SAMPLES = 4096
# A basis direction with a smaller eigenvalue, relative to the largest one, holds only rounding errors (float64 sums of
# 1e7 samples).
SINGULAR = 1e-13
# Least noise, relative to the signal: exact data would have none, and weights would be infinite. Sums of squares are
# rounded at 1e-15, their square roots at 3e-8.
NOISE_FLOOR = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """Factor of a window's least-squares problem: its sum of squares over all points is |r X - rhs|^2 + tr(residual).

    X (p, 3) are the coefficients of V on the basis 1, u (m channels) and, with the derivative, du/dt (m channels): a
    row for each function of the basis, a column for each output axis. `r` (p, p), its row 0 belongs to the means; `rhs`
    (p, 3) in output unit; `residual` (3, 3) scatter of V about the window's own regression; `count` of samples.
    """

    r: Array
    rhs: Array
    residual: Array
    count: float


def window_sums(u: ArrayLike, du: ArrayLike, V: ArrayLike, segment_edges: ArrayLike) -> WindowSums:
    """Sums of a window of n samples, segment by segment.

    `u` (n, m) is the reference in m/s2, `du` (n, m) its derivative in m/s3, `V` (n, 3) the indications in output unit,
    all at the same times. `segment_edges` (K + 1,) are rising sample numbers: segment k holds the samples
    [edges[k], edges[k + 1]); an empty segment is dropped. Raises ValueError if shapes do not fit, a value is not
    finite, or there is no sample.
    """
    channels, rates, indications = (np.asarray(x, dtype=float) for x in (u, du, V))
    n, m = channels.shape
    if rates.shape != (n, m) or indications.shape != (n, 3):
        raise ValueError(f"shapes do not fit: u {channels.shape}, du {rates.shape}, V {indications.shape}")
    bounds = _bounds(np.asarray(segment_edges, dtype=np.int64), n)
    parts = [_segments(channels[a:b], rates[a:b], indications[a:b], count) for a, b, count in _alike(bounds)]
    mean, scatter = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not (np.isfinite(mean).all() and np.isfinite(scatter).all()):
        raise ValueError("a window's samples must be finite: leave out samples that are missing (NaN)")
    return WindowSums(m, np.array([float(b - a) for a, b in bounds]), mean, scatter)


def _bounds(edges: NDArray[np.int64], n: int) -> list[tuple[int, int]]:
    """First sample of each segment and that after its last, without the segments that are empty. Raises ValueError."""
    if edges.size < 2 or np.any(np.diff(edges) < 0) or edges[0] < 0 or edges[-1] > n:
        raise ValueError(f"segment edges must rise within 0..{n} (two or more sample numbers), are {edges.tolist()}")
    bounds = [(int(a), int(b)) for a, b in itertools.pairwise(edges) if b > a]
    if not bounds:
        raise ValueError("a window needs at least one sample")
    return bounds


def merge(parts: Sequence[WindowSums]) -> WindowSums:
    """The segments of all parts, in the order given. Raises ValueError if their numbers of channels differ."""
    channels = {p.reference_channels for p in parts}
    if len(channels) != 1:
        raise ValueError(f"sums on different bases cannot be merged: {sorted(channels)} reference channels")
    return WindowSums(
        channels.pop(),
        np.concatenate([p.count for p in parts]),
        np.concatenate([p.mean for p in parts]),
        np.concatenate([p.scatter for p in parts]),
    )


def pool(sums: WindowSums) -> WindowSums:
    """All segments merged into one, with the sums over all points (Chan, Golub and LeVeque 1983, for many parts)."""
    mean, scatter = _pool(sums.count, sums.mean, sums.scatter)
    return WindowSums(sums.reference_channels, np.array([sums.count.sum()]), mean[None], scatter[None])


def factor(sums: WindowSums, *, derivative: bool = False) -> Factor:
    """The factor of a window on the basis [1, u], or with `derivative` on [1, u, du/dt], from its centred sums.

    Rows of directions that the window does not excite are zero.
    """
    whole = pool(sums)
    n, mean, scatter = float(whole.count[0]), whole.mean[0], whole.scatter[0]
    m = whole.reference_channels
    used, out = slice(0, 2 * m if derivative else m), slice(2 * m, 2 * m + 3)
    p = used.stop
    r, rhs = np.zeros((p + 1, p + 1)), np.zeros((p + 1, 3))
    r[0, 0], r[0, 1:], rhs[0] = np.sqrt(n), np.sqrt(n) * mean[used], np.sqrt(n) * mean[out]
    residual = scatter[out, out]
    if p:
        scale = np.sqrt(np.diag(scatter)[used])
        scale[scale == 0.0] = 1.0
        values, vectors = np.linalg.eigh(scatter[used, used] / np.outer(scale, scale))
        root = np.sqrt(np.where(values > SINGULAR * max(values[-1], 0.0), values, 0.0))
        r[1:, 1:] = root[:, None] * vectors.T * scale
        inverse = np.divide(1.0, root, out=np.zeros_like(root), where=root > 0.0)
        rhs[1:] = inverse[:, None] * (vectors.T @ (scatter[used, out] / scale[:, None]))
        residual = residual - rhs[1:].T @ rhs[1:]
    return Factor(r, rhs, residual, n)


def _alike(bounds: Sequence[tuple[int, int]]) -> Iterator[tuple[int, int, int]]:
    """(first, stop, number) of neighbouring segments that have one length, BLOCK_SAMPLES together or a single one."""
    for size, group in itertools.groupby(bounds, key=lambda segment: segment[1] - segment[0]):
        segments, most = list(group), max(BLOCK_SAMPLES // size, 1)
        for k in range(0, len(segments), most):
            together = segments[k : k + most]
            yield together[0][0], together[-1][1], len(together)


def _segments(u: Array, du: Array, V: Array, count: int) -> tuple[Array, Array]:
    """Means (count, q) and centred scatter (count, q, q) of segments of one length; each block fits the cache and is
    read twice."""
    if len(u) > BLOCK_SAMPLES:  # a single segment
        starts = range(0, len(u), BLOCK_SAMPLES)
        blocks = [_segments(u[k:][:BLOCK_SAMPLES], du[k:][:BLOCK_SAMPLES], V[k:][:BLOCK_SAMPLES], 1) for k in starts]
        sizes = np.array([float(min(BLOCK_SAMPLES, len(u) - k)) for k in starts])
        mean, scatter = _pool(sizes, *(np.concatenate(part) for part in zip(*blocks, strict=True)))
        return mean[None], scatter[None]
    m = u.shape[1]
    z = np.empty((2 * m + 3, len(u)))  # one channel per row: 1.6 times as fast as one sample per row
    z[:m], z[m : 2 * m], z[2 * m :] = u.T, du.T, V.T
    segments = z.reshape(len(z), count, -1).transpose(1, 0, 2)
    centre = segments @ np.ones(segments.shape[2]) / segments.shape[2]
    segments -= centre[:, :, None]
    return centre, segments @ segments.transpose(0, 2, 1)


def _pool(count: Array, mean: Array, scatter: Array) -> tuple[Array, Array]:
    difference = mean - mean[0]
    shift = count @ difference / count.sum()
    difference = difference - shift
    return mean[0] + shift, scatter.sum(axis=0) + (count * difference.T) @ difference
