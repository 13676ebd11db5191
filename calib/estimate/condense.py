"""What the adjustment needs of the windows: whitened slopes, means, and how noisy both are.

Within a window V is regressed on the reference's basis x = [u, du/dt] and 1. The slopes b are kept as R b, R'R being
the centred scatter of x: never inverted, so what was not excited is a row of zeros, and the conditioning of the whole
is that of the geometry alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.estimate.type_a import FEWEST_FREEDOM, LEAST_INFLATION, Segments, TypeA, pooled
from calib.model import Array, Window, own_channels

PIVOT_FLOOR = 1e-9  # of a channel's own power; what is left after the channels before it is rounding below that
# Part of the strongest channel's power below which a direction counts as not excited: 1 % of its amplitude, where the
# noise of a reference would else be taken for motion that the sensor does not feel.
EXCITED = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Condensed:
    """Slopes and means of W windows.

    `root` (W, 2M, 2M) is R, `slopes` (W, 2M, 3) is R b, `omega2` (W,) in rad2/s2 the power ratio of du/dt to u,
    `mean_x` (W, 2M), `mean_v` (W, 3), `count` (W,).
    """

    channels: int
    root: Array
    slopes: Array
    omega2: Array
    mean_x: Array
    mean_v: Array
    count: Array
    type_a: TypeA


def condense(windows: Sequence[Window], *, alike: bool = False) -> Condensed:
    """Condense the windows' sums; M is the largest number of reference channels among them.

    `alike` as in calib.estimate.type_a.pooled.
    """
    channels = max(w.sums.reference_channels for w in windows)
    segments = [_segments(w, channels) for w in windows]
    roots, whiteners = zip(*(_root(s.xx.sum(0)) for s in segments), strict=True)
    return Condensed(
        channels=channels,
        root=np.array(roots),
        slopes=np.array([t @ s.xv.sum(0) for t, s in zip(whiteners, segments, strict=True)]),
        omega2=np.array([_omega2(s.xx.sum(0), channels) for s in segments]),
        mean_x=np.array([s.mean[:-3] for s in segments]),
        mean_v=np.array([s.mean[-3:] for s in segments]),
        count=np.array([s.count.sum() for s in segments]),
        type_a=pooled(segments, roots, whiteners, alike=alike),
    )


def effective(data: Condensed, independent: float) -> Condensed:
    """The same in units in which slopes and means scatter by one on average, as what segments show.

    Coloured or filtered noise leaves fewer independent points, and so less weight against priors. Where segments tell
    little, the filter's share of `independent` points stands for them.
    """
    type_a, live = data.type_a, np.repeat(np.any(np.diagonal(data.root, axis1=1, axis2=2) > 0.0, axis=0), 3)
    freedom = type_a.degrees_of_freedom if np.isfinite(type_a.degrees_of_freedom) else 0.0
    own = min(freedom / FEWEST_FREEDOM, 1.0)
    seen = [type_a.slope_ratio(live) if live.any() else 1.0, np.diag(type_a.means).mean()]
    slopes, means = (max(own * float(ratio) + (1.0 - own) / independent, LEAST_INFLATION) for ratio in seen)
    return replace(
        data,
        root=data.root / np.sqrt(slopes),
        slopes=data.slopes / np.sqrt(slopes),
        count=data.count / means,
        type_a=replace(type_a, slopes=type_a.slopes / slopes, means=type_a.means / means),
    )


def _segments(window: Window, channels: int) -> Segments:
    """Sums of one window by segment, centred on the window's mean, with missing reference channels as zeros."""
    own = window.sums.reference_channels
    keep = [*range(own), *range(channels, channels + own), *range(2 * channels, 2 * channels + 3)]
    size = 2 * channels + 3
    count = np.asarray(window.sums.count, dtype=np.float64)
    mean = np.zeros((len(count), size))
    mean[:, keep] = window.sums.mean
    scatter = np.zeros((len(count), size, size))
    scatter[np.ix_(range(len(count)), keep, keep)] = window.sums.scatter
    centre = count @ mean / count.sum()
    mean -= centre
    scatter += count[:, None, None] * mean[:, :, None] * mean[:, None, :]
    x = slice(0, 2 * channels)
    noise = np.zeros(2 * channels)
    if window.reference_noise is not None:
        for powers, at in zip(window.reference_noise**2, (0, channels), strict=True):
            noise[at : at + len(powers)] = powers
    return Segments(
        count, scatter[:, x, x], scatter[:, x, -3:], scatter[:, -3:, -3:], count[:, None] * mean, centre, noise
    )


def _root(power: Array) -> tuple[Array, Array]:
    """R (2M, 2M) upper with R'R = power and T with T power = R; rows of zeros where there is no power of its own."""
    size = len(power)
    half = size // 2
    strongest = np.repeat([power.diagonal()[:half].max(initial=0.0), power.diagonal()[half:].max(initial=0.0)], half)
    limit = np.maximum(PIVOT_FLOOR * power.diagonal(), EXCITED * strongest)
    moved = power.diagonal() > limit  # a channel of noise alone must not tie its unknown column to the known ones
    power = np.where(np.outer(moved, moved), power, 0.0)
    work = np.hstack([power, np.eye(size)])
    rows = np.zeros_like(work)
    for j in range(size):
        if work[j, j] > max(limit[j], 0.0):
            rows[j] = work[j] / np.sqrt(work[j, j])
            work = work - rows[j, :size, None] * rows[j]
    return np.triu(rows[:, :size]), rows[:, size:]


def _omega2(power: Array, channels: int) -> float:
    real = own_channels(channels)
    moved = float(np.trace(power[:real, :real]))
    return (
        float(np.trace(power[channels : channels + real, channels : channels + real])) / moved if moved > 0.0 else 0.0
    )
