"""What the adjustment needs of the windows: whitened slopes, means, and how noisy both are.

Within a window V is regressed on the reference's basis x = [u, du/dt] and 1. The slopes b are kept as R b, R'R being
the centred scatter of x: never inverted, so what was not excited is a row of zeros, and the conditioning of the whole
is that of the geometry alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.estimate.type_a import Segments, TypeA, pooled
from calib.model import Array, Window, own_channels

PIVOT_FLOOR = 1e-9  # of a channel's own power; what is left after the channels before it is rounding below that
# Part of the strongest channel's power below which a direction counts as not excited: 1 % of its amplitude, where the
# noise of a reference would else be taken for motion that the sensor does not feel.
EXCITED = 1e-4
QUIET_FACTOR = 1.0  # a channel's power without the quiet power must exceed the quiet power, else it is noise of noise


@dataclass(frozen=True, slots=True, eq=False)
class Condensed:
    """B blocks of slopes (one a window, or one a position where quiet windows are) and W means.

    `root` (B, 2M, 2M) is R, `slopes` (B, 2M, 3) is R b, `block_window` (B,) an index of a window with the block's
    pose, `omega2` (B,) in rad2/s2 the power ratio of du/dt to u, `mean_omega2` (W,) that of the windows.
    `mean_x` (W, 2M), `mean_v` (W, 3), `count` (W,).
    """

    channels: int
    root: Array
    slopes: Array
    block_window: list[int]
    omega2: Array
    mean_x: Array
    mean_v: Array
    mean_omega2: Array
    count: Array
    type_a: TypeA


def condense(windows: Sequence[Window], quiet: Sequence[Window] = ()) -> Condensed:
    """Condense the windows' sums; M is the largest number of reference channels among them.

    `quiet` windows (same reference and position, hardly any motion) tell the power of the reference's own noise: their
    mean x x' and x V' are taken out of the loud ones', which removes the attenuation by errors in variables.
    """
    channels = max(w.sums.reference_channels for w in windows)
    segments = [_segments(w, channels) for w in windows]
    blocks, block_window = segments, list(range(len(windows)))
    floors = np.zeros((len(windows), 2 * channels))
    if quiet:
        blocks, block_window, floors = _without_quiet(windows, segments, quiet, channels)
    roots, whiteners = zip(*(_root(b.xx.sum(0), f) for b, f in zip(blocks, floors, strict=True)), strict=True)
    slopes = [t @ b.xv.sum(0) for t, b in zip(whiteners, blocks, strict=True)]
    mean_v = np.array([s.mean[-3:] for s in segments])
    count = np.array([s.count.sum() for s in segments])
    omega2 = np.array([_omega2(b.xx.sum(0), channels) for b in blocks])
    return Condensed(
        channels=channels,
        root=np.array(roots),
        slopes=np.array(slopes),
        block_window=block_window,
        omega2=omega2,
        mean_x=np.array([s.mean[:-3] for s in segments]),
        mean_v=mean_v,
        mean_omega2=np.array([_omega2(s.xx.sum(0), channels) for s in segments]) if quiet else omega2,
        count=count,
        type_a=pooled(segments, blocks, _blocks_of(windows, block_window), roots, whiteners),
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
    return Segments(count, scatter[:, x, x], scatter[:, x, -3:], scatter[:, -3:, -3:], count[:, None] * mean, centre)


def _without_quiet(
    windows: Sequence[Window], segments: list[Segments], quiet: Sequence[Window], channels: int
) -> tuple[list[Segments], list[int], Array]:
    """One block a position with quiet windows, their mean power taken out; the other windows as they are."""
    blocks, first, floors = [], [], []
    positions = dict.fromkeys(w.pose.position for w in windows)
    for position in positions:
        loud = [i for i, w in enumerate(windows) if w.pose.position == position]
        calm = [_segments(w, channels) for w in quiet if w.pose.position == position]
        if not calm:
            blocks += [segments[i] for i in loud]
            first += loud
            floors += [np.zeros(2 * channels)] * len(loud)
            continue
        own, still = _joined([segments[i] for i in loud]), _joined(calm)
        n = still.count.sum()
        xx, xv = still.xx.sum(0) / n, still.xv.sum(0) / n
        # The calm segments' sum is zero then: they add nothing but the scatter of the mean that is taken.
        blocks.append(_joined([own.less(xx, xv), still.less(xx, xv, weight=-own.count.sum() / n)]))
        first.append(loud[0])
        floors.append(QUIET_FACTOR * own.count.sum() * np.diag(xx))
    return blocks, first, np.array(floors)


def _blocks_of(windows: Sequence[Window], block_window: list[int]) -> list[int]:
    """Which block holds a window's slopes: its own, else its position's."""
    by_position = {windows[i].pose.position: b for b, i in enumerate(block_window)}
    own = {i: b for b, i in enumerate(block_window)}
    return [own.get(i, by_position[w.pose.position]) for i, w in enumerate(windows)]


def _joined(parts: Sequence[Segments]) -> Segments:
    count, xx, xv, vv, total = (np.concatenate(column) for column in zip(*(p.sums() for p in parts), strict=True))
    return Segments(count, xx, xv, vv, total, parts[0].mean)


def _root(power: Array, floor: Array) -> tuple[Array, Array]:
    """R (2M, 2M) upper with R'R = power and T with T power = R; rows of zeros where there is no power of its own."""
    size = len(power)
    half = size // 2
    strongest = np.repeat([power.diagonal()[:half].max(initial=0.0), power.diagonal()[half:].max(initial=0.0)], half)
    limit = np.maximum.reduce([PIVOT_FLOOR * power.diagonal(), EXCITED * strongest, floor])
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
