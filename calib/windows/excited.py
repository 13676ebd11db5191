"""The channels of a reference that were excited in a window, and the correction of the sums for the reference's noise.

A silent channel holds only noise, or noise beside a signal that it shares with a stronger channel (its motion is not
exactly along one axis). Least squares would take the noise for a motion that the sensor does not follow, and find too
small values in that column of S. So silent channels are removed from the basis, and the shared part of their motion is
added to the directions of the other channels: the part in phase to those of u, the part 90 deg ahead to those of du/dt.

What a silent channel shares is known to its noise, which turns the plane of the motion, or its line, another way in
each window. From these small differences least squares would tell S in the direction that nothing excited. So windows
that excite a plane or a line are judged together, in the eigenvectors of the covariance of their motion less that of
the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.model import U_NOISE, Array, BandSums, Pose, Window, WindowSums, own_channels
from calib.windows.bands import without_noise

# Least power of an excited channel, relative to its noise. Noise reduces the slopes; the correction for it leaves a
# tenth of that error, which is then at most 1 %.
OVER_NOISE = 10.0
OF_STRONGEST = 1e-4  # least power relative to that of the strongest channel: 1 % of its amplitude
WEAK = 1e-2  # of a channel with less of the strongest channel's power, what is 90 deg ahead of that one is shared too
ROUNDING = 1e-12  # of a channel's power, what is left may be a rounding error
MOST_NOISE = 0.5  # largest part of a segment's power that the correction may subtract
SAME_RAD = 1e-5  # stated directions that differ by less are one
AXES = "xyz"
NOISE_LEFT = 3.0 * U_NOISE  # of the noise's power, what the correction may leave: three of these


@dataclass(frozen=True, slots=True, eq=False)
class Excitation:
    """A window after the correction: silent channels are removed, and the noise's power is subtracted from the others.

    `window` is the one before. `pose` tells the shared motion of silent channels. `directions` (3, k) are orthonormal
    vectors that span the excited directions, in the sensor's frame. `attenuation` is the relative standard uncertainty
    of all slopes of the window that the correction leaves. `live` (m,) flags the channels that were excited, `noise`
    (2, m) is the power of the reference's noise in u and du/dt. `turned`: what silent channels share turns the
    directions away from those of the channels, and their noise turns them too.

    `sums` and `bands` are made anew whenever they are asked for: to keep those of all windows of a day would take as
    much memory as the windows.
    """

    window: Window
    pose: Pose
    directions: Array
    attenuation: float
    live: NDArray[np.bool_]
    noise: Array
    turned: bool = False

    @property
    def reference_noise(self) -> Array | None:
        """As that of the window."""
        return self.window.reference_noise

    @property
    def independent(self) -> float:
        """As that of the window."""
        return self.window.independent

    @property
    def silent_noise(self) -> Array:
        """(3,) power in m2/s4 along the sensor's axes of the noise of silent channels: what they share with the motion
        is known to it. Zeros at rest."""
        silent = ~self.live if self.live.any() else np.zeros_like(self.live)
        return np.asarray(self.window.pose.direction[:, : len(silent)][:, silent] ** 2 @ self.noise[0][silent])

    @property
    def noise_shares(self) -> Array:
        """(2M,) noise over motion, as power, of each channel of the sums and of its derivative; 0 where none counts."""
        m, channels = len(self.live), self.window.sums.reference_channels
        found, at = np.zeros(2 * channels), np.r_[0:m, channels : channels + m]
        clean = np.diagonal(_power(self.window, between=True)) - self.noise.ravel()
        found[at] = np.divide(
            self.noise.ravel(), clean, out=np.zeros(2 * m), where=np.tile(self.live, 2) & (clean > 0.0)
        )
        return found

    @property
    def sums(self) -> WindowSums:
        """The sums after the correction."""
        sums, live = self.window.sums, self.live
        if live.all() and not self.noise.any():
            return sums
        channels = sums.reference_channels  # m, or 2 m if the integrals follow (see calib.signal.corner)
        both = _columns(live, channels)
        scatter = sums.scatter.copy() if live.all() else np.where(np.outer(both, both), sums.scatter, 0.0)
        for power, at in zip(self.noise, (0, channels), strict=True):
            for k in np.flatnonzero(live):
                own = scatter[:, at + k, at + k]
                scatter[:, at + k, at + k] = own - np.minimum(sums.count * power[k], MOST_NOISE * own)
        if live.all():
            return WindowSums(channels, sums.count, sums.mean, scatter)
        # Each segment gets the window's mean of a silent channel: differences between segments would count as motion
        # again. The mean itself is kept, because the sensor is subject to it too (gravity, if the reference is
        # DC-coupled).
        mean = sums.count @ sums.mean / sums.count.sum()
        return WindowSums(channels, sums.count, np.where(both, sums.mean, mean), scatter)

    @property
    def bands(self) -> BandSums | None:
        """The bands with motion after the correction."""
        bands, live = self.window.bands, self.live
        if bands is None or own_channels(bands.reference_channels) != len(live) or not live.any():
            return None
        if not live.all():
            both = _columns(live, bands.reference_channels)
            products, noise = np.where(np.outer(both, both), bands.products, 0.0), np.where(both, bands.noise, 0.0)
            bands = replace(bands, products=products, noise=noise)
        if self.window.u_noise > U_NOISE:  # a noise of which only the most is known must not bend the response
            channels = bands.reference_channels
            bands = replace(bands, noise=np.where(np.arange(2 * channels + 3) < 2 * channels, 0.0, bands.noise))
        return without_noise(bands)


def excited_together(windows: Sequence[Window]) -> tuple[list[Excitation], Array]:
    """Each window as `excited` leaves it, and the directions (3, k) that they excite together, orthonormal, in the
    sensor's frame. Where k is below 3, no window has motion in other directions: what shows there is noise.

    k is 3 where a window excites all directions. Beside a uniaxial reference they are the stated directions of motion.
    """
    found = [excited(w) for w in windows]
    moved = [e for e in found if e.live.any()]
    if moved and all(len(e.live) == 1 for e in moved):
        return found, _spanned(np.hstack([e.pose.direction[:, :1] for e in moved]))
    if not moved or any(len(e.live) != len(AXES) or e.live.all() or not e.noise.any() for e in moved):
        return found, np.eye(len(AXES))
    ways = excited_ways([motion_of(e.window) for e in moved])
    if ways.shape[1] == len(AXES):
        return found, np.eye(len(AXES))
    return [_within(e, ways) if e.live.any() else e for e in found], ways


def _spanned(directions: Array) -> Array:
    """(3, k) an orthonormal basis of what unit vectors (3, n) span; those within SAME_RAD are one."""
    ways, size, _ = np.linalg.svd(directions)
    told = np.count_nonzero(size > SAME_RAD * size[0])
    return np.eye(len(AXES)) if told == len(AXES) else ways[:, :told]


@dataclass(frozen=True, slots=True, eq=False)
class MotionSums:
    """Sums over the points of a window beside a tri-axial reference, in the sensor's frame: `power` (3, 3) of its
    motion, the noise's subtracted, and `noise` (3, 3) of the reference's noise, in m2/s4."""

    power: Array
    noise: Array

    def plus(self, other: MotionSums) -> MotionSums:
        """Both together."""
        return MotionSums(self.power + other.power, self.noise + other.noise)


def motion_of(window: Window) -> MotionSums:
    """The motion in a window beside a tri-axial reference."""
    m, points = len(AXES), float(window.sums.count.sum())
    direction, noise = window.pose.direction[:, :m], np.zeros(m)
    if window.reference_noise is not None:
        noise = window.reference_noise[0] ** 2
    power = _power(window, between=True)[:m, :m] - np.diag(noise)
    return MotionSums(points * direction @ power @ direction.T, points * (direction * noise) @ direction.T)


def excited_ways(motions: Sequence[MotionSums]) -> Array:
    """(3, k) the eigenvectors of the motion of all windows along which at least one of them moves: more than noise, and
    more than 1 % of its strongest motion."""
    power, noise = (np.array([getattr(motion, name) for motion in motions]) for name in ("power", "noise"))
    ways = np.linalg.eigh(power.sum(axis=0))[1]
    own, own_noise = (np.einsum("ik,nij,jk->nk", ways, part, ways) for part in (power, noise))
    moved = (own > OVER_NOISE * own_noise) & (own > OF_STRONGEST * np.linalg.eigvalsh(power)[:, -1:])
    return np.asarray(ways[:, moved.any(axis=0)])


def _within(found: Excitation, ways: Array) -> Excitation:
    """The window with its motion along `ways` (3, k), and in other directions what it surely shares with that motion.

    Without `ways` a silent channel is told by u and du/dt of the others. Of a tone on an ellipse these are one another,
    so that the same motion is told by u or by du/dt. The plane tells it by u alone.
    """
    if np.count_nonzero(found.live) > ways.shape[1]:
        found = excited(found.window, most=ways.shape[1])
    pose, m, live = found.pose, len(found.live), np.flatnonzero(found.live)
    direction, pairs = pose.direction[:, :m], np.eye(pose.direction.shape[1] // m)
    inside = np.linalg.solve(direction, ways)
    beside = np.linalg.svd(ways)[0][:, ways.shape[1] :]
    told = np.linalg.solve(direction, beside) @ _surely_shared(found, beside.T @ direction)
    if len(live) == ways.shape[1]:
        along, ahead = np.zeros((m, m)), np.zeros((m, m))
        along[:, live] = inside @ np.linalg.pinv(inside[live])
        told = told - along[:, live] @ told[live]  # the live channels are what they indicate
    else:
        assert pose.along is not None
        assert pose.along_rate_s is not None
        within = inside @ ways.T @ direction
        along, ahead = within @ pose.along[:m, :m], within @ pose.along_rate_s[:m, :m]
    along[:, live] += told[:, : len(live)]
    ahead[:, live] += told[:, len(live) :]
    shared = [np.asarray(np.kron(pairs, part), dtype=float) for part in (along, ahead)]
    pose = replace(pose, along=shared[0], along_rate_s=shared[1])
    return replace(found, pose=pose, directions=np.linalg.qr(direction @ along[:, live])[0])


def _surely_shared(found: Excitation, across: Array) -> Array:
    """(j, 2 k) what motions `across` (j, m) share with u and du/dt of the k live channels; 0 where it may be noise."""
    window, m = found.window, len(found.live)
    moving, power = np.flatnonzero(np.tile(found.live, 2)), _power(window)
    clean = _clean(power, found.noise)
    both = across @ clean[:m, moving]
    told = _regression(both, clean, found.noise, power, moving)
    noise = (across**2 @ found.noise[0]) * len(moving) / (window.independent * window.sums.count.sum())
    return np.where((np.sum(told * both, axis=1) > OVER_NOISE * noise)[:, None], told, 0.0)


def excited(window: Window, most: int = 3) -> Excitation:
    """The window with its silent channels removed and the noise's power subtracted; `most` channels stay at most.

    A window at rest, or of a uniaxial reference whose noise is not known, is not changed.
    """
    m = own_channels(window.sums.reference_channels)
    noise = np.zeros((2, m)) if window.reference_noise is None else window.reference_noise**2
    if m == 0:
        return Excitation(window, window.pose, np.zeros((3, 0)), 0.0, np.ones(0, dtype=bool), noise)
    both = _power(window, between=True)
    power = both[:m, :m]
    own = _own_power(both, noise[0], most)
    live = own > 0.0
    if live.all() and window.reference_noise is None and window.bands is None:  # nothing to remove or to subtract
        return Excitation(window, window.pose, np.linalg.qr(window.pose.direction[:, :m])[0], 0.0, live, noise)
    share = float(np.max(noise[0][live] / own[live], initial=0.0))
    along, ahead = _shared(window, live, noise)
    # The shared motion of a silent channel turns the excited direction if it is more than noise and more than 1 %.
    shown = along**2 @ np.where(live, power.diagonal(), 0.0)
    askew = shown > np.maximum(OF_STRONGEST * power.diagonal().max(initial=0.0), OVER_NOISE * noise[0])
    direction = window.pose.direction[:, :m]
    turned = direction + direction @ np.where(askew[:, None], along, 0.0)
    basis, _ = np.linalg.qr(turned[:, np.flatnonzero(live)])
    pose = window.pose if live.all() else _shared_in(window.pose, live, along, ahead)
    return Excitation(window, pose, basis, window.u_noise * share, live, noise, bool(askew.any()))


def _columns(live: NDArray[np.bool_], channels: int) -> NDArray[np.bool_]:
    """(2 channels + 3,) flags of the columns of a window's sums that stay."""
    every = np.tile(live, channels // len(live))
    return np.concatenate([every, every, [True] * 3])


def _shared_in(pose: Pose, live: NDArray[np.bool_], along: Array, ahead: Array) -> Pose:
    """The pose with the motion that silent channels share. The stated directions stay: the silent channel measured the
    shared motion, and its error is in `along`."""
    pairs = np.eye(pose.direction.shape[1] // len(live))
    moving, rate = (
        np.asarray(np.kron(pairs, part), dtype=float) for part in (np.diag(live.astype(float)) + along, ahead)
    )
    return replace(pose, along=moving, along_rate_s=rate)


def _power(window: Window, *, between: bool = False) -> Array:
    """(2 m, 2 m) covariance of u and du/dt of a reference's own channels within segments; with that `between` them."""
    sums, m = window.sums, own_channels(window.sums.reference_channels)
    columns = np.r_[0:m, sums.reference_channels : sums.reference_channels + m]
    products, count = sums.scatter[:, columns[:, None], columns].sum(axis=0), sums.count.sum()
    if between:
        away = sums.mean[:, columns] - sums.count @ sums.mean[:, columns] / count
        products = products + (sums.count[:, None] * away).T @ away
    return np.asarray(products / count)


def _own_power(power: Array, noise: Array, most: int) -> Array:
    """(m,) power of each channel that the stronger channels do not explain; 0 for a silent channel.

    `power` (2 m, 2 m) is the covariance of u and du/dt of all channels, `noise` (m,) the power of the noise of u. No
    more than `most` channels are excited. A motion in one direction that is oblique to the channels appears in all of
    them, but it excites one direction only: the strongest channel represents it, and the remainder in the other
    channels is noise. A WEAK channel may share the part of a stronger one that is 90 deg ahead as well: du/dt stands
    beside u in the regression, so only what neither explains tells a slope. Strong channels keep that part: motion in a
    circle excites two directions.
    """
    m = len(noise)
    own, strongest = np.zeros(m), power.diagonal()[:m].max(initial=0.0)
    rest, beside = power[:m, :m].copy(), power.copy()
    for _ in range(min(most, m)):
        left = np.where(own > 0.0, 0.0, rest.diagonal())
        k = int(np.argmax(left))
        alone = beside[k, k] if left[k] < WEAK * strongest else left[k]
        if left[k] <= OF_STRONGEST * strongest or alone <= OVER_NOISE * noise[k]:
            break
        own[k] = alone
        rest -= np.outer(rest[:, k], rest[k]) / left[k]
        for column in (k, m + k):
            if beside[column, column] > ROUNDING * power[column, column]:
                beside -= np.outer(beside[:, column], beside[column]) / beside[column, column]
    return own


def _shared(window: Window, live: NDArray[np.bool_], noise: Array) -> tuple[Array, Array]:
    """The shared motion of the silent channels (rows): (m, m) on u of the live channels (columns), and (m, m) in s on
    their du/dt. The elements of other rows and columns are 0. `noise` (2, m) is the power of the reference's noise.
    """
    m, power = len(live), _power(window, between=True)
    found = np.zeros((m, 2 * m))
    if live.any() and not live.all():
        moving = np.flatnonzero(np.tile(live, 2))
        both = power[np.ix_(np.flatnonzero(~live), moving)]
        found[np.ix_(~live, np.tile(live, 2))] = _regression(both, _clean(power, noise), noise, power, moving)
    return found[:, :m], found[:, m:]


def _clean(power: Array, noise: Array) -> Array:
    """(2 m, 2 m) the covariance of u and du/dt without that of the noise (2, m)."""
    return np.asarray(power - np.diag(np.minimum(noise.ravel(), MOST_NOISE * power.diagonal())))


def _regression(both: Array, clean: Array, noise: Array, power: Array, moving: NDArray[np.intp]) -> Array:
    """(j, k) regression on the channels `moving` (k,) of [u, du/dt], with which signals have the covariance `both`.

    Of a tone on an ellipse, du/dt is a sum of the channels of u: in such a combination the subtraction leaves noise
    alone, of which nothing can be told.
    """
    unit = np.sqrt(power.diagonal()[moving])
    values, ways = np.linalg.eigh(clean[np.ix_(moving, moving)] / np.outer(unit, unit))
    by_noise = (noise.ravel()[moving] / unit**2) @ ways**2
    told = values > np.maximum(OF_STRONGEST * values[-1], NOISE_LEFT * by_noise)
    ways = ways[:, told]
    return np.asarray(both / unit @ (ways / values[told]) @ ways.T / unit)
