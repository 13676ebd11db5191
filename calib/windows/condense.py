"""The data of the adjustment: whitened slopes and means of each window, and their noise.

Within a window, V is regressed on the reference's basis x = [u, du/dt] and 1. The slopes b are stored as R b, where R'R
is the centred scatter of x. R is never inverted: a direction without excitation is a row of zeros, and the condition of
the problem depends on the geometry alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib.model import Array, BandSums, Pose, WindowSums, own_channels
from calib.signal.response import POWERS
from calib.windows.banded import Banded, banded
from calib.windows.bands import along_motion
from calib.windows.excited import NOISE_LEFT, OF_STRONGEST
from calib.windows.type_a import LEAST_INFLATION, Index, Segments, TypeA, in_order, pooled

PIVOT_FLOOR = 1e-9  # of a channel's power: a smaller remainder, after the channels before it, is a rounding error
# Least power of an excited direction, relative to that of the strongest channel. In a weaker direction the noise of the
# reference would be taken for a motion that the sensor does not follow. Half the limit of calib.windows.excited: a
# channel that it found to be excited stays so after the noise was subtracted, which is a tenth of its power at most.
EXCITED = 0.5 * OF_STRONGEST
# Of the power of a channel's derivative, what other channels leave of it: with less it is mostly another channel.
SHARED = 0.5
ROUNDING = 1e-12  # of a channel's mean: in a window in which it is constant, digits alone move it by less


class WindowToCondense(Protocol):
    """What is condensed: a calib.model.Window, or what calib.windows.excited leaves of it."""

    @property
    def pose(self) -> Pose: ...

    @property
    def sums(self) -> WindowSums: ...

    @property
    def bands(self) -> BandSums | None: ...

    @property
    def reference_noise(self) -> Array | None: ...

    @property
    def silent_noise(self) -> Array: ...

    @property
    def independent(self) -> float: ...


@dataclass(frozen=True, slots=True, eq=False)
class Condensed:
    """Slopes and means of W windows with M = `channels` reference channels.

    `root` (W, 2M, 2M) is R; `slopes` (W, 2M, 3) is R b; `omega2` (W,) in rad2/s2 is the power of du/dt over that of u;
    `mean_x` (W, 2M) and `mean_v` (W, 3) are the means of the basis and of V; `count` (W,) is the number of samples;
    `type_a` is their noise. `telling` (3,) flags the outputs whose slopes tell S: all, but beside a uniaxial reference
    on a structure that moves across it (calib.adjustment.across).
    """

    channels: int
    root: Array
    slopes: Array
    omega2: Array
    mean_x: Array
    mean_v: Array
    count: Array
    type_a: TypeA
    bands: Banded | None = None
    telling: NDArray[np.bool_] = field(default_factory=lambda: np.ones(3, dtype=bool))


def condense(
    windows: Sequence[WindowToCondense],
    *,
    alike: bool = False,
    response_hz: float = 0.0,
    one_frequency: bool = False,
    powers: int = len(POWERS),
) -> Condensed:
    """Condense the windows' sums; M is the largest number of reference channels among them.

    `alike` as in calib.windows.type_a.pooled. `response_hz`: upper end of the motion that is to tell the response
    over frequency; 0 where that is no unknown. `one_frequency`, `powers`: see calib.windows.banded.
    """
    sums = [w.sums for w in windows]
    channels = max(own.reference_channels for own in sums)
    parts = _segments(windows, sums, channels)
    del sums  # of a day, as much memory as the parts
    powers_of = [part.xx.sum(1) for part in parts]
    roots, whiteners = zip(*map(_roots, powers_of, map(_left, parts)), strict=True)
    omega2, of_each = (in_order(parts, own) for own in zip(*(_omega2(p, channels) for p in powers_of), strict=True))
    told = None
    if response_hz:
        bands = (_along(w) for w in windows)
        told = banded(bands, channels, response_hz, omega2, of_each, one_frequency=one_frequency, powers=powers)
    return Condensed(
        channels=channels,
        root=in_order(parts, roots),
        slopes=in_order(parts, [t @ part.xv.sum(1) for t, part in zip(whiteners, parts, strict=True)]),
        omega2=omega2,
        mean_x=in_order(parts, [part.mean[:, :-3] for part in parts]),
        mean_v=in_order(parts, [part.mean[:, -3:] for part in parts]),
        count=in_order(parts, [part.count.sum(1) for part in parts]),
        type_a=pooled(parts, roots, whiteners, alike=alike),
        bands=told,
    )


def _along(window: WindowToCondense) -> BandSums | None:
    """The bands that tell the response: of V along the motion, where the reference measures no other one."""
    bands = window.bands
    if bands is None or own_channels(bands.reference_channels) != 1:
        return bands
    return along_motion(bands, window.pose.direction[:, 0])


def regressed(root: Array, slopes: Array) -> Array:
    """b (..., 2M, 3) from R (..., 2M, 2M) and R b. A channel that those before it make up has no part of b: the
    derivative of an integral is a channel itself, and would have half of S by the least norm."""
    live = np.diagonal(root, axis1=-2, axis2=-1) ** 2 > PIVOT_FLOOR * np.sum(root**2, axis=-2)
    return np.asarray(np.linalg.pinv(root * live[..., None, :], rcond=1e-9) @ slopes)


def mean_frequency_hz(data: Condensed) -> float:
    """The mean frequency of the motion, by power; 0 where nothing moves, or where the response is no unknown."""
    real = range(own_channels(data.channels))
    power = np.sum(data.root[:, :, real] ** 2, axis=1)
    if data.bands is None or not power.any():
        return 0.0
    square = -data.bands.projected[:, 0, real, real]  # by c_2, the slopes on u move by -omega^2
    # Of few tones the derivative of one channel is mostly what other channels tell, and tells little beside them.
    rates = [data.channels + k for k in real]
    alone, whole = data.root[:, rates, rates] ** 2, np.sum(data.root[:, :, rates] ** 2, axis=1)
    shared = (alone < SHARED * whole).any(axis=1)
    square[shared] = data.omega2[shared, None]
    return float(np.sqrt(max(np.sum(power * square), 0.0) / power.sum())) / (2.0 * np.pi)


def effective(data: Condensed, independent: Array) -> Condensed:
    """The same data, scaled so that the noise of slopes and means has the variance 1 on average.

    Coloured or filtered noise leaves fewer independent points, so the data must have less weight compared with the
    priors. `independent` (W,) is the share of independent points that the filters leave; the scatter between segments
    shows how much fewer there are still.
    """
    type_a, live = data.type_a, np.repeat(np.any(np.diagonal(data.root, axis1=1, axis2=2) > 0.0, axis=0), 3)
    seen = [type_a.slope_ratio(live) if live.any() else 1.0, np.diag(type_a.means).mean()]
    slopes, means = (max(type_a.known * float(ratio) + 1.0 - type_a.known, LEAST_INFLATION) for ratio in seen)
    less = np.sqrt(slopes / independent)[:, None, None]
    return replace(
        data,
        root=data.root / less,
        slopes=data.slopes / less,
        count=data.count / means * independent,
        type_a=replace(type_a, slopes=type_a.slopes / slopes, means=type_a.means / means),
    )


def _segments(windows: Sequence[WindowToCondense], sums: Sequence[WindowSums], channels: int) -> list[Segments]:
    """Sums of the windows by segment, centred on each window's mean; windows of one shape together."""
    shapes: dict[tuple[int, int], list[int]] = {}
    for w, own in enumerate(sums):
        shapes.setdefault((own.reference_channels, len(own.count)), []).append(w)
    return [_alike(np.array(at), windows, [sums[w] for w in at], channels) for at in shapes.values()]


def _alike(at: Index, windows: Sequence[WindowToCondense], sums: Sequence[WindowSums], channels: int) -> Segments:
    """`sums` of the windows `at`, equal in segments and channels; channels that they do not have are zeros."""
    own = sums[0].reference_channels
    keep = np.array([*range(own), *range(channels, channels + own), *range(2 * channels, 2 * channels + 3)])
    size = 2 * channels + 3
    count = np.array([each.count for each in sums], dtype=np.float64)
    mean = np.zeros((*count.shape, size))
    mean[..., keep] = [each.mean for each in sums]
    centre = (count[:, None] @ mean)[:, 0] / count.sum(1)[:, None]
    mean -= centre[:, None]
    scatter = np.zeros((*count.shape, size, size))
    for held, each, weight, away in zip(scatter, sums, count, mean, strict=True):  # one by one: no copy of them all
        held[:, keep[:, None], keep] = each.scatter
        held += weight[:, None, None] * away[:, :, None] * away[:, None, :]
    noise = np.zeros((len(sums), 2 * channels))
    for own_noise, w in zip(noise, at.tolist(), strict=True):
        if (rms := windows[w].reference_noise) is not None:
            for powers, first in zip(rms**2, (0, channels), strict=True):
                own_noise[first : first + len(powers)] = powers
    x = slice(0, 2 * channels)
    return Segments(
        at,
        count,
        scatter[..., x, x],
        scatter[..., x, -3:],
        scatter[..., -3:, -3:],
        count[..., None] * mean,
        centre,
        noise,
        np.array([windows[w].silent_noise for w in at.tolist()]),
        np.array([windows[w].independent for w in at.tolist()]),
    )


def _left(part: Segments) -> tuple[Array, Array]:
    """The power (W, 2M) of each channel of which no sum tells a motion: rounding errors of the mean, which all segments
    of a silent channel have; and the power (W, 2M) of the reference's noise of which the subtraction may leave a share.

    Of a tone on an ellipse the derivative of one channel is another channel: beside it, noise alone is left. So the
    noise is that of motion in a plane; zeros for a motion in all directions.
    """
    own, count = np.diagonal(part.xx.sum(1), axis1=1, axis2=2), part.count.sum(1)[:, None]
    rounded = count * (ROUNDING * part.mean[:, : own.shape[1]]) ** 2
    plane = (own <= rounded).any(axis=1)[:, None]
    return rounded, np.where(plane, count * part.noise, 0.0)


def _roots(power: Array, left: tuple[Array, Array]) -> tuple[Array, Array]:
    """R (W, 2M, 2M), upper triangular with R'R = power, and T with T power = R.

    A channel without power of its own has rows of zeros: so much as rounding and noise may have `left` is none. What
    other channels leave of a channel has their noise too, by the squares of what they tell of it.
    """
    size, (rounded, noise) = power.shape[-1], left
    own, half = np.diagonal(power, axis1=1, axis2=2), size // 2
    strongest = np.repeat(own.reshape(len(own), 2, half).max(axis=2, initial=0.0), half, axis=1)
    limit = np.maximum(np.maximum(PIVOT_FLOOR * own, EXCITED * strongest), rounded)
    moved = own > np.maximum(limit, NOISE_LEFT * noise)  # a silent channel must not correlate its column with others
    moved[:, half + own_channels(half) :] = False  # the derivative of an integral is its own channel
    power = np.where(moved[:, :, None] & moved[:, None], power, 0.0)
    work = np.concatenate([power, np.broadcast_to(np.eye(size), power.shape)], axis=2)
    rows = np.zeros_like(work)
    for j in range(size):
        pivot, by_noise = work[:, j, j], np.sum(work[:, j, size:] ** 2 * noise, axis=1)
        live = pivot > np.maximum(limit[:, j], NOISE_LEFT * by_noise)
        root = np.sqrt(np.where(live, pivot, 1.0))[:, None]
        rows[:, j] = np.where(live[:, None], work[:, j] / root, 0.0)
        work = work - rows[:, j, :size, None] * rows[:, j, None]
    return np.triu(rows[..., :size]), rows[..., size:]


def _omega2(products: Array, channels: int) -> tuple[Array, Array]:
    """The power of du/dt over that of u: of all channels but integrals together (W,), and of each (W, M)."""
    power, rate_power = np.split(np.diagonal(products, axis1=1, axis2=2), 2, axis=1)
    real = own_channels(channels)
    each = np.divide(rate_power, power, out=np.zeros(power.shape), where=power > 0.0)
    moved, rate = power[:, :real].sum(axis=1), rate_power[:, :real].sum(axis=1)
    return np.divide(rate, moved, out=np.zeros(len(moved)), where=moved > 0.0), each
