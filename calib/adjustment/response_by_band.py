"""The response over frequency, each band by itself: what is told where no smooth response explains all bands.

In a band V = S(f) a with a complex S(f), the same in all windows (Eq. (8) at one frequency). Its real part belongs to
the reference u, its imaginary part over omega to du/dt. Nothing is assumed of other bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.adjustment.adjustment import Adjustment
from calib.distributions import chi2_quantile
from calib.estimate.quantities import LAG, RESPONSE
from calib.estimate.response_told import BandSensitivity, KnownResponses, ResponseTold
from calib.model import Array, BandSums, Pose, Window
from calib.signal.response import Complex
from calib.windows.banded import Factors
from calib.windows.bands import without_integrals
from calib.windows.deviations import PROBABILITY
from calib.windows.excited import excited_together

PER_OCTAVE = 6  # bands, as many as those of a window
NARROW = 1.5  # ends of a window's band, so near that it stands for its middle; those of short windows are wider
UNSEEN = 1e-6  # part of an element of S that lies in directions which no window excited
MOST_CHANGE = 0.5  # of ln S, from the mean frequency of the motion in a band to the middle of the band


def response_by_band(found: Adjustment, windows: Sequence[Window]) -> ResponseTold | None:
    """What the adjustment says of the response, with the sensitivity of each band told by that band alone.

    `windows`, from which the same lag is taken out as from those of the adjustment, and no response. Their bands are
    tapered by HANN (calib.windows.bands), because motion that leaks from a band with another response would bend it.
    u has all that the adjustment knows besides: angles, reference, mounting. NaN where a band tells nothing.
    """
    told, grounds = found.response, found.grounds
    used = _moved(windows)
    if told is None or not used or grounds.priors.response_model.one_frequency:
        return told
    terms, k = grounds.solution.equations.nuisances, PER_OCTAVE * len(told.bands) // 3
    edges_hz = np.geomspace(told.bands[0].low_hz, told.bands[-1].high_hz, k + 1)
    middles_hz = np.sqrt(edges_hz[:-1] * edges_hz[1:])
    left_s = sum(float(x) for x, t in zip(grounds.solution.x[12:], terms.terms, strict=True) if t.kind is LAG)
    taken = np.exp(2j * np.pi * middles_hz * left_s) * KnownResponses.of(grounds.priors).size(
        middles_hz, told.reference_frequency_hz
    )
    sources = dict.fromkeys(t.source for t in terms.terms if t.kind is not RESPONSE)
    stated = np.sqrt(np.sum([found.contributions[source][:9] ** 2 for source in sources], axis=0)).reshape(3, 3)
    return replace(told, bands=_bands(used, edges_hz, taken, stated))


_Moved = tuple[Pose, BandSums]  # how a window stands, and its bands


def _moved(windows: Sequence[Window]) -> list[_Moved]:
    """What is used of the windows that have bands."""
    found = [(own.pose, own.bands) for own in excited_together([w for w in windows if w.used])[0]]
    return [(pose, without_integrals(bands)) for pose, bands in found if bands is not None]


def _bands(windows: Sequence[_Moved], edges_hz: Array, taken: Complex, stated: Array) -> tuple[BandSensitivity, ...]:
    """The complex sensitivities at the middles of the bands between `edges_hz` (B + 1,).

    `taken` (B,): what the data were divided by. `stated` (3, 3): the standard uncertainty of S by all that has nothing
    to do with the scatter in the bands, in output unit per m/s2.
    """
    ends = list(zip(edges_hz[:-1].tolist(), edges_hz[1:].tolist(), strict=True))
    rows = [_BandRows.of(windows, *end) for end in ends]
    found = [own.solved() for own in rows]
    at_hz = np.array([own.frequency_hz for own in rows])
    left = at_the_middles(np.array([own for own, _ in found]), at_hz, np.sqrt(edges_hz[:-1] * edges_hz[1:]))
    told = left * taken[:, None, None]
    u = np.hypot([u * abs(h) for (_, u), h in zip(found, taken.tolist(), strict=True)], _within(told))
    return tuple(BandSensitivity(*end, *band) for end, *band in zip(ends, told, np.hypot(u, stated), strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class _BandRows:
    """The slopes of all windows in one band: `rows` (R, 6) for the real and the imaginary parts of a row of S, `slopes`
    (R, 3) by output axis, `noise` (R, 3) of these; the mean frequency of the motion, NaN where there is none.
    `incoherent` (3,): the power of an axis that the reference does not explain, over what it explains."""

    rows: Array
    slopes: Array
    noise: Array
    frequency_hz: float
    incoherent: Array

    @classmethod
    def of(cls, windows: Sequence[_Moved], low_hz: float, high_hz: float) -> _BandRows:
        """Those of the windows' bands whose middles are in this band."""
        parts, power, square = [(np.zeros((0, 6)), np.zeros((0, 3)), np.zeros((0, 3)))], 0.0, 0.0
        told, lost, at_hz = np.zeros(3), np.zeros(3), float(np.sqrt(low_hz * high_hz))
        for pose, bands in windows:
            middle_hz, m = np.sqrt(bands.low_hz * bands.high_hz), bands.reference_channels
            inside = (middle_hz >= low_hz) & (middle_hz < high_hz)
            around = (bands.low_hz <= at_hz) & (bands.high_hz > at_hz) & (bands.high_hz < NARROW * bands.low_hz)
            kept = np.flatnonzero(inside | around)
            if not kept.size:
                continue
            factors, along = Factors(bands, kept), pose.direction[:, :m]
            if pose.along is not None:  # a silent channel shares the motion of the others
                along = along @ pose.along[:m, :m]
            real, imaginary = factors.root[..., :m] @ along.T, factors.root[..., m:] @ along.T
            both = np.concatenate([real, imaginary / factors.omega[:, None, None]], axis=2)
            own = (both.reshape(-1, 6), factors.slopes.reshape(-1, 3), np.repeat(factors.noise, 2 * m, axis=0))
            parts.append(own)
            told, lost = told + factors.told.sum(axis=0), lost + factors.left.sum(axis=0)
            moved = np.diagonal(factors.gram, axis1=1, axis2=2)
            power, square = power + float(moved[:, :m].sum()), square + float(moved[:, m:].sum())
        moved_hz = float(np.sqrt(square / power)) / (2.0 * np.pi) if power > 0.0 else np.nan
        frequency_hz = float(np.clip(moved_hz, low_hz, high_hz))  # stronger motion leaks into the ends of a window
        incoherent = np.divide(lost, told, out=np.zeros(3), where=told > 0.0)
        rows, slopes, noise = (np.concatenate(part) for part in zip(*parts, strict=True))
        return cls(rows, slopes, noise, frequency_hz, incoherent)

    def solved(self) -> tuple[Complex, Array]:
        """S (3, 3), complex, and its standard uncertainty from the scatter; NaN where no window tells an element."""
        found, u = np.full((6, 3), np.nan), np.full((6, 3), np.nan)
        for axis in range(3) if len(self.rows) else ():
            weighted, seen = (part / self.noise[:, axis, None] for part in (self.rows, self.slopes[:, axis, None]))
            ways, size, vectors = np.linalg.svd(weighted, full_matrices=False)
            live = size > UNSEEN * size[0]
            told = 1.0 - np.sum(vectors[live] ** 2, axis=0) < UNSEEN
            inverse = vectors[live].T / size[live]
            estimate = inverse @ (ways.T[live] @ seen)
            square, freedom = float(np.sum((seen - weighted @ estimate) ** 2)), len(seen) - int(np.count_nonzero(live))
            # Between windows, and between the bands that make this one: as much more than noise as there is.
            more = square / freedom if freedom and square > chi2_quantile(PROBABILITY, float(freedom)) else 1.0
            found[told, axis] = estimate[told, 0]
            # Nobody knows whose noise it is: as that of the reference it makes S low by up to this share.
            low = self.incoherent[axis] / np.sqrt(3.0) * np.linalg.norm(estimate.reshape(2, 3), axis=0)
            u[told, axis] = np.hypot(np.sqrt(more) * np.linalg.norm(inverse, axis=1), np.tile(low, 2))[told]
        return (found[:3] + 1j * found[3:]).T, np.hypot(u[:3], u[3:]).T


def at_the_middles(left: Complex, at_hz: Array, middles_hz: Array) -> Complex:
    """Sensitivities (B, 3, 3), each at the mean frequency of the motion in its band, at the middles of the bands.

    The motion of a band may lie at one end of it, and where the response is steep this matters. Two bands that show one
    tone at their common end tell no slope: a sensitivity that would change by more than MOST_CHANGE stays.
    """
    out = left.copy()
    for row, column in np.ndindex(3, 3):
        own = left[:, row, column]
        told = np.flatnonzero(np.isfinite(own) & (np.abs(own) > 0.0))
        told = told[np.diff(at_hz[told], prepend=-np.inf) > 0.0]
        if len(told) < 2:
            continue
        x, log = np.log(at_hz[told]), np.log(np.abs(own[told])) + 1j * np.unwrap(np.angle(own[told]))
        change = np.gradient(log, x) * (np.log(middles_hz[told]) - x)
        near = np.abs(change) <= MOST_CHANGE
        out[told[near], row, column] = own[told[near]] * np.exp(change[near])
    return out


def _within(told: Complex) -> Array:
    """(B, 3, 3) how far a response may bend within a band: an eighth of the second difference of neighbouring bands."""
    bent = np.zeros(told.shape)
    if len(told) > 2:
        second = np.abs(told[2:] - 2.0 * told[1:-1] + told[:-2]) / 8.0
        bent[1:-1], bent[0], bent[-1] = second, second[0], second[-1]
    return np.where(np.isfinite(bent), bent, 0.0)
