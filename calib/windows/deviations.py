"""How far bands of frequency deviate from one response, and what else they leave open (calib.windows.banded).

The bands of windows are summed up here, so that memory does not grow with the windows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from calib.distributions import chi2_quantile
from calib.model import Array
from calib.signal.order_statistics import median
from calib.signal.response import POWERS, by_term

PROBABILITY = 0.99  # confidence of the test for scatter between bands
# To which the variance of the noise of bands is known: it is taken to be steady, and noise that comes with gusts and
# lorries gives the slopes of bands up to a fifth more (benchmarks.online.bridge). So much shows no other response.
NOISIER = 1.2
SURELY = 3.0  # standard uncertainties of noise beyond the white noise that chance does not explain
LEAST_SHOWN = 0.1  # of the motion of the axis that moved most: noise of an axis with less says little of the reference
MEDIAN_U = 1.2533  # standard uncertainty of a median over that of a mean
TINY = 1e-300
# Mean square, over that of one axis, by which three axes differ from their mean in 95 of 100 cases: chi^2_2(0.95) / 3.
EXPLAINED = -2.0 * float(np.log(0.05)) / 3.0
U_CORNER = 0.01  # standard uncertainty of the corner of an axis, relative to that of all axes; c_2 then differs by 2 %


@dataclass(frozen=True, slots=True, eq=False)
class BetweenBands:
    """How far bands deviate, beyond their noise, from the response that fits all of them best (see Deviations).

    `scatter` is the relative SD, 0 where noise explains all. A narrow feature raises the noise of its band and so has
    little weight in it: `shift` is how far the deviations move the slopes of whole windows, relative; 0 where noise
    explains that. `at_hz` is the frequency that contributes most, and `largest` the deviation there.
    """

    scatter: float = 0.0
    shift: float = 0.0
    at_hz: float = 0.0
    largest: float = 0.0

    @property
    def relative_u(self) -> float:
        """Relative standard uncertainty of S if nothing else explains the deviations."""
        return self.beyond(0.0)

    def beyond(self, explained: float) -> float:
        """Relative standard uncertainty of S by the part of the deviations that exceeds a relative SD `explained`."""
        return max(float(np.sqrt(max(self.scatter**2 - explained**2, 0.0))), self.shift)


@dataclass(frozen=True, slots=True)
class Deviations:
    """Sums over the bands of windows, from which `between` follows. The sums of several windows add.

    `square` of the rows that the best response leaves, in units of their noise, with `freedom` degrees of freedom;
    `signal` of the rows themselves; `moved`, `power` and `variance`: how far the deviations move the slopes of whole
    windows, their size, and the variance that noise alone gives to `moved`. `at_hz`, `largest` as in BetweenBands.
    """

    freedom: float = 0.0
    square: float = 0.0
    signal: float = 0.0
    moved: float = 0.0
    power: float = 0.0
    variance: float = 0.0
    at_hz: float = 0.0
    largest: float = 0.0

    def plus(self, other: Deviations) -> Deviations:
        """Those of both; the frequency is that of the larger deviation."""
        worst = max(self, other, key=lambda one: one.largest)
        added = {name: getattr(self, name) + getattr(other, name) for name in _ADDED}
        return replace(worst, **added)

    @property
    def times_noise(self) -> float:
        """The variance of the rows over that of their noise; 1 where noise alone shows as much in one of 100 cases."""
        if self.freedom < 1.0 or self.square <= NOISIER * chi2_quantile(PROBABILITY, self.freedom):
            return 1.0
        return max(self.square / self.freedom, 1.0)

    @property
    def between(self) -> BetweenBands:
        """The deviations beyond noise, which shows as much in one of 100 cases."""
        if self.freedom < 1.0:
            return BetweenBands()
        excess = self.square - NOISIER * self.freedom if self.times_noise > 1.0 else 0.0
        shifted = self.moved**2 > NOISIER * chi2_quantile(PROBABILITY, 1.0) * self.variance
        shift = abs(self.moved) / self.power if shifted else 0.0
        return BetweenBands(float(np.sqrt(max(excess, 0.0) / self.signal)), shift, self.at_hz, self.largest)


_ADDED = ("freedom", "square", "signal", "moved", "power", "variance")


Third = tuple[int, tuple[float, ...]]


class ByAxis(NamedTuple):
    """The effect of axes that do not respond quite alike. `u`: relative standard uncertainty of a row of S. `explains`:
    relative SD of the bands' deviations that such axes explain in 95 of 100 cases."""

    u: float = 0.0
    explains: float = 0.0


@dataclass(frozen=True, slots=True)
class LeftOpen:
    """Sums over the bands of windows for what no band tells: whose noise it is, and whether all axes respond alike.

    `thirds`: for each third of an octave its number, and nine sums, three for each output axis: the power of V that the
    motion explains, the power of the rest beyond the white noise of sensor and reference, and the variance of the
    latter. `moments` (K): of the power that is explained, weighted by the effect of each term of the response on
    ln |h|.
    """

    thirds: tuple[Third, ...] = ()
    moments: tuple[float, ...] = ()

    def plus(self, other: LeftOpen) -> LeftOpen:
        """Those of both."""
        if not self.thirds or not other.thirds:
            return self if self.thirds else other
        mine, its = dict(self.thirds), dict(other.thirds)
        both = {k: _sum(mine[k], its[k]) if k in mine and k in its else mine.get(k) or its[k] for k in mine | its}
        return LeftOpen(tuple(sorted(both.items())), _sum(self.moments, other.moments))

    @classmethod
    def load(cls, state: Mapping[str, Sequence[Any]]) -> LeftOpen:
        """The object whose `asdict` this is, with lists in the place of tuples."""
        return cls(tuple((k, tuple(sums)) for k, sums in state["thirds"]), tuple(state["moments"]))

    def lost(self, at_hz: float) -> float:
        """By how much the reference's noise may make S smaller at a frequency, relative: if all noise is its own that
        is not white and that chance does not explain.

        It is the median of the bands within an octave: noise in a few bands makes these bands deviate, and is no part
        of a smooth response. Of the axis where it is largest; axes that hardly moved do not count.
        """
        return _lost(self.thirds, at_hz)

    def u_lost(self, at_hz: float) -> float:
        """Relative standard uncertainty of S by that: an error between 0 and `lost`, all as likely, not corrected."""
        return self.lost(at_hz) / float(np.sqrt(3.0))

    def by_axis(self, terms: Array, at_reference: Array, powers: Sequence[int] = POWERS) -> ByAxis:
        """The effect of corners that differ by U_CORNER from axis to axis. `terms` (K,) of the response, their effects
        `at_reference` (K,) where S holds, and their `powers`.

        A term is proportional to the inverse of the corner to its power.
        """
        if not terms.any() or not self.thirds:
            return ByAxis()
        by_corner = np.array(powers) * terms
        away = _mean_effects(self) - at_reference
        u = float(U_CORNER * abs(np.sum(by_corner * away)))
        return ByAxis(u, U_CORNER * float(np.sqrt(EXPLAINED * _beside_gain_and_lag(self.thirds, by_corner))))


def _sum(one: tuple[float, ...], other: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(a + b for a, b in zip(one, other, strict=True))


# A state is asked several times between two windows.
@lru_cache(maxsize=8)
def _mean_effects(of: LeftOpen) -> Array:
    """(K,) the mean effect of each term on ln |h|, weighted by the power of V that the motion explains. Read-only."""
    found = np.array(of.moments) / max(sum(sum(own[:3]) for _, own in of.thirds), TINY)
    found.flags.writeable = False
    return found


def _beside_gain_and_lag(thirds: tuple[Third, ...], terms: Array) -> float:
    """The mean square of the effect of `terms` (K,) on ln h that neither a gain nor a lag explains. The weights are the
    powers of V that the motion explains."""
    weight = np.array([sum(own[:3]) for _, own in thirds])
    weight = weight / max(weight.sum(), TINY)
    omega = 2.0 * np.pi * np.exp2(np.array([k for k, _ in thirds]) / 3.0)
    effect = by_term(omega, len(terms)) @ terms
    lag_s = (weight @ (omega * effect.imag)) / max(weight @ omega**2, TINY)
    left = effect - weight @ effect.real - 1j * omega * lag_s
    return float(weight @ np.abs(left) ** 2)


@lru_cache(maxsize=8)
def _lost(thirds: tuple[Third, ...], at_hz: float) -> float:
    """As LeftOpen.lost."""
    if not thirds:
        return 0.0
    octaves = np.array([k for k, _ in thirds]) / 3.0 - (np.log2(at_hz) if at_hz > 0.0 else 0.0)
    near = np.abs(octaves) <= 1.0
    sums = np.array([own for _, own in thirds]).reshape(-1, 3, 3)[near if near.any() else slice(None)]
    shown, unshown, variance = sums.transpose(1, 2, 0)  # each (3, bands)
    share = unshown / np.maximum(shown, TINY)
    u_each = np.sqrt(variance) / np.maximum(shown, TINY)
    with np.errstate(over="ignore"):  # infinite for an axis that shows nothing at all in a band
        u = MEDIAN_U * np.sqrt(np.mean(u_each**2, axis=1) / u_each.shape[1])
    middle, total = median(share), shown.sum(axis=1)
    counted = (middle > SURELY * u) & (total > LEAST_SHOWN * total.max())
    return float(np.max(middle[counted], initial=0.0))
