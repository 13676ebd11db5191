"""A structure that moves across a uniaxial reference: what the outputs across show of it, out of that along.

The motion a along the reference is known, the motion t across it is not. All outputs respond alike over frequency:

    V_a = s a + r t          V_p = q a + P t          a: the output along, p: the two across
    V_a - c V_p = (s - c q) a                         c = r P^-1, of the size of a transverse sensitivity

This difference does not feel t at all, and s - c q differs from s, an element of S, by the product of two transverse
sensitivities. c is found from what the outputs have in common beside the motion along, in bands of frequency. Where t
only follows a, as in a single mode, nothing tells c: u of s then contains t times what a transverse sensitivity may be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.estimate.axes import MOST_TRANSVERSE
from calib.estimate.determined import Flags
from calib.model import Array, BandSums, Window
from calib.windows.banded import Factors
from calib.windows.bands import LEAST_SHARE
from calib.windows.excited import Excitation

# Noise of an axis over that of another one, as variances: of MEMS 6 at most (2.5 times the rms). Times what is stated,
# from which the motion across that the data show counts.
NOISIER_AXIS, MORE_ACROSS = 10.0, 2.0
LEAST_ACROSS = 0.05  # of the motion along: with less, as on a shaker, S along is as right, and the other outputs tell S
ALONG = 0.9995  # least cosine between the motion and an axis of the sensor: 1.8 deg
U_TRANSVERSE = 0.03  # of a transverse sensitivity over a main one, where nobody states it. MEMS have 1 to 3 %
QUIET = 0.25  # of the bands: there, what motion along leaves of an output across is mostly noise
LEAST_REST = 1e-4  # of what the motion leaves of the output along, as power
NOTHING_KNOWN = 1e3 * U_TRANSVERSE
TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, slots=True, eq=False)
class Across:
    """`motion`: rms of the motion across over that along, 0 where it is not much more than stated. `output`: the one
    along, of which it was taken out; None where nothing was. `factors` are c, `u` the standard uncertainty of S of
    that output that is left, relative."""

    motion: float = 0.0
    output: int | None = None
    factors: tuple[float, float] = (0.0, 0.0)
    u: float = 0.0

    @property
    def telling(self) -> Flags:
        """(3,) the outputs whose slopes tell S."""
        return np.array([self.output is None or i == self.output for i in range(3)])

    def taken_out(self, windows: Sequence[Window]) -> list[Window]:
        """The windows without it. Their bands hold the output along alone: the others tell no response."""
        return [self._without(w) for w in windows]

    def _without(self, window: Window) -> Window:
        others, sums, m = np.flatnonzero(~self.telling), window.sums, window.sums.reference_channels
        along, beside = 2 * m + int(np.flatnonzero(self.telling)[0]), 2 * m + others
        to = np.eye(2 * m + 3)
        to[along, beside] = -np.array(self.factors)
        mean = sums.mean @ to.T
        mean[:, along] += sums.count @ (sums.mean - mean)[:, along] / sums.count.sum()  # Q is none of the motion's
        sums = replace(sums, mean=mean, scatter=to @ sums.scatter @ to.T)
        if (bands := window.bands) is None:
            return replace(window, sums=sums)
        to[beside, beside] = 0.0
        noise = bands.noise.copy()
        noise[:, along] += noise[:, beside] @ np.array(self.factors) ** 2
        noise[:, beside] = 0.0
        return replace(window, sums=sums, bands=replace(bands, products=to @ bands.products @ to.T, noise=noise))


def across_of(windows: Sequence[Excitation], stated: float) -> Across:
    """What the windows show of motion across a uniaxial reference, of which `stated` is the rms over that of the motion
    along. It is taken out of the output along where all windows are of one direction, that of an axis of the sensor."""
    alone = [w for w in windows if w.live.all() and len(w.live) == 1]
    bands = [own for own in (w.bands for w in alone) if own is not None and len(own.points)]
    if not bands:
        return Across()
    motion = _motion_across(bands)
    ways = np.array([w.pose.direction[:, 0] for w in windows if w.live.any()])
    output = int(np.argmax(np.abs(ways[0])))
    if len(alone) < len(ways) or np.abs(ways[:, output]).min() < ALONG:
        return Across(motion if motion > MORE_ACROSS * stated else 0.0)
    taken_out = _taken_out_of(output, bands, max(motion, stated))
    motion = max(motion, taken_out.motion)
    return replace(taken_out, motion=motion if motion > MORE_ACROSS * stated else 0.0)


def _taken_out_of(output: int, bands: Sequence[BandSums], motion: float) -> Across:
    """`Across` of the output along, where `motion` across, or what follows the motion along, is no transverse
    sensitivity."""
    others, left, density = [i for i in range(3) if i != output], np.zeros((3, 3)), list[Array]()
    points = freedom = along = power = 0.0
    follows = np.zeros((2, 2))
    for own in bands:
        factors, m = Factors(own, np.arange(len(own.points))), own.reference_channels
        each = own.products[:, 2 * m :, 2 * m :] - factors.slopes.mT @ factors.slopes
        left += each.sum(axis=0)
        density.append(each[:, others, others] / own.points[:, None])
        points, freedom = points + float(own.points.sum()), freedom + float(factors.free.sum()) * own.independent
        moved = factors.slopes[..., others]
        along += float(factors.left[:, output].sum())
        power += float((factors.slopes[..., output] ** 2).sum())
        follows += (moved.mT @ moved).sum(axis=0)
    follows /= max(power, TINY)
    if motion < LEAST_ACROSS and float(np.trace(follows)) < MOST_TRANSVERSE**2:
        return Across()
    common, shared = left[np.ix_(others, others)], left[others, output]
    rest = max(along - float(shared @ np.linalg.pinv(common) @ shared), LEAST_REST * along, TINY)
    quiet = points * np.quantile(np.concatenate(density), QUIET, axis=0)
    white = np.diag(np.minimum(np.minimum(quiet, NOISIER_AXIS * rest), np.diag(common)))
    inverse = np.linalg.inv(common + np.eye(2) * rest / NOTHING_KNOWN**2)
    by_chance = np.linalg.inv((common - white) * max(freedom, 1.0) / rest + np.eye(2) / NOTHING_KNOWN**2)
    # A lag or a response that changes shows in all outputs alike, as far as they follow the motion along. And white
    # noise of the outputs across takes from c.
    by_data = by_chance + inverse @ (rest**2 * follows + U_TRANSVERSE**2 * white @ white) @ inverse
    weight = U_TRANSVERSE**2 * np.linalg.inv(by_data + U_TRANSVERSE**2 * np.eye(2))
    c, covariance = weight @ inverse @ shared, U_TRANSVERSE**2 * (np.eye(2) - weight)
    # No transverse sensitivity is so large: outputs are copies, or the sensor is turned against what was stated.
    if np.abs(c).max() > MOST_TRANSVERSE:
        return Across()
    u2 = float(np.sum(covariance * follows) + c @ c * U_TRANSVERSE**2)
    return Across(float(np.sqrt(np.trace(follows))), output, (float(c[0]), float(c[1])), float(np.sqrt(max(u2, 0.0))))


def _motion_across(bands: Sequence[BandSums]) -> float:
    """The rms of motion across a uniaxial reference that the sensor shows along an axis, over that of the motion. The
    part of it that follows the motion looks like S, and is about as large.

    It is what the motion leaves of the outputs in the bands that move, beyond what it leaves of the output that moves
    most: there, noise of the reference shows as well, and a response. 0 where that is not much more in most of these
    bands: hum and other lines are in few.
    """
    power = beyond = 0.0
    for each in bands:
        own = Factors(each, np.arange(len(each.points)))
        moved = own.told.sum(axis=1)
        moved = np.where(moved > LEAST_SHARE * moved.max(initial=0.0), moved, 0.0)
        power += float(moved.sum())
        along, most = own.left[:, int(np.argmax(own.told.sum(axis=0)))], own.left.max(axis=1)
        if moved[most > NOISIER_AXIS * along].sum() > 0.5 * moved.sum():
            beyond += float((most - along)[moved > 0.0].sum())
    return float(np.sqrt(beyond / power)) if power > 0.0 else 0.0
