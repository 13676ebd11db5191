"""Knocks of the sensor that the reference does not feel, found before any filter.

A filter spreads a knock over its whole length, and the spectrum of a knock looks like motion. So samples that are
knocks are told from the motion before the band of the motion is looked for. What the reference shows as well is no
knock: after a blow to the structure the residual tells how both instruments respond, and where a mount rattles or
slips it is the mount's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.distributions import chi2_quantile
from calib.excitation import detection
from calib.excitation.detection import KNOCK_SD, ROUNDING, Mask
from calib.excitation.window_verdict import DEFAULT_LIMITS
from calib.model import Array
from calib.signal.order_statistics import median

CLEAR_SD = 10.0  # robust SDs that a knock reaches: what a filter makes of less is hardly seen
FLANK_SD = 2.0  # where a knock begins and ends: noise alone is beyond in one sample of eight
BRIDGED_S = 0.02  # a shorter pause does not end a knock: half a period of a part that rings at 25 Hz
LONGEST_S = 0.5  # a mount that slips stays where it is, and a continuous rattle goes on
NEARBY_S = 0.25  # before a sample and after it; a mount rings as long after a blow
MOST_OF_THEM = 0.5  # of the samples beyond KNOCK_SD are in knocks; what rattles is beyond it by any amount
INSIDE_PCT = DEFAULT_LIMITS.most_left_out_pct
BESIDE_PCT = DEFAULT_LIMITS.most_left_out_of_segment_pct  # before and after the stretch, the sensor may be turned
TIED_BY_CHANCE = 0.02  # of windows with knocks at random times: theirs seem to be where the motion is strong


def knocks(columns: Array, inside: Mask, rate_hz: float) -> tuple[Mask, Array]:
    """Flags (n,) of samples that are knocks, and the residual (n, 3) of V from what the motion explains.

    `columns` (n, 3 + p) are V, and of the reference all that V is regressed on; rows with NaN are missing samples.
    `inside` (n,) are the samples of the stretch that the regression uses; those beyond may be of another position. A
    knock is a run of samples beyond five robust SDs, with its flanks, that reaches CLEAR_SD of them, times the power of
    the motion nearby over its usual one: the residual of a response that is not taken out grows with the motion. None
    are found where more samples would be knocks than a window may have, where most samples beyond five SDs are in none,
    or where the motion makes them.
    """
    none, whole = np.zeros(len(columns), dtype=bool), np.asarray(np.isfinite(columns).all(axis=1))
    own = whole & inside
    if np.count_nonzero(own) <= 2 * columns.shape[1] or (beyond := _beyond(columns, whole, own)) is None:
        return none, np.zeros((len(columns), 3))
    residual, away = beyond
    motion = _scaled(np.where(whole[:, None], columns[:, 3:], 0.0) - columns[own, 3:].mean(axis=0), own)
    clear = away / _times_usual(motion, own, rate_hz) > CLEAR_SD
    struck = none.copy()
    bridged = max(round(BRIDGED_S * rate_hz), 1)
    for a, b in _runs(away, bridged):
        struck[a:b] = whole[a:b] & (b - a <= LONGEST_S * rate_hz) & clear[a:b].any()
    first, stop = np.flatnonzero(own)[[0, -1]] + [0, 1]
    parts = (slice(first), BESIDE_PCT), (slice(first, stop), INSIDE_PCT), (slice(stop, None), BESIDE_PCT)
    for part, most_pct in parts:
        if 100.0 * struck[part].sum() > most_pct * whole[part].sum():
            struck[part] = False
    beyond_own = own & (away > KNOCK_SD)
    if np.count_nonzero(struck & beyond_own) < MOST_OF_THEM * np.count_nonzero(beyond_own):
        return none, residual
    begin = np.flatnonzero(np.diff(struck & own, prepend=False) & struck & own)
    before = np.maximum(begin - bridged, 0)  # the knock itself may move the reference a little
    return (none, residual) if _tied(motion, own, before[own[before]]) else (struck, residual)


def _beyond(columns: Array, whole: Mask, own: Mask) -> tuple[Array, Array] | None:
    """The residual (n, 3) of V from its regression on the motion, and its largest axis (n,) in robust SDs; both 0 where
    samples are missing. None where no sample of the stretch is beyond five of them."""
    V, basis = columns[:, :3], np.column_stack([np.ones(len(columns)), columns[:, 3:]])
    finest = detection.least_step(V[own])
    found, of_own = detection.knocked(np.asfortranarray(V[own]), basis[own], finest)
    if not found.any():
        return None
    rounding = ROUNDING * float(np.abs(V[own]).max())
    sd = np.maximum(1.4826 * median(np.abs(of_own[~found].T)), np.maximum(0.5 * finest, rounding))
    kept, residual = np.flatnonzero(own)[~found], np.zeros((len(columns), 3))
    slopes = detection.regression(np.ascontiguousarray(basis[kept].T), np.ascontiguousarray(V[kept].T))
    residual[whole] = V[whole] - basis[whole] @ slopes.T
    return residual, np.asarray((np.abs(residual) / sd).max(axis=1))


def _scaled(motion: Array, own: Mask) -> Array:
    """The motion (n, p) in units of the rms of each column."""
    tiny = np.finfo(float).tiny
    motion = motion / np.maximum(np.abs(motion[own]).max(axis=0), tiny)  # first, so that no square overflows
    return np.asarray(motion / np.maximum(np.sqrt(np.mean(motion[own] ** 2, axis=0)), tiny))


def _times_usual(motion: Array, own: Mask, rate_hz: float) -> Array:
    """(n,) the largest power of the motion (n, p) nearby over the median of that; 1 where it is less than usual."""
    power = np.sum(motion**2, axis=1)
    size = max(round(NEARBY_S * rate_hz), 1)
    blocks = np.maximum.reduceat(power, np.arange(0, len(power), size))
    padded = np.concatenate([blocks[:1], blocks, blocks[-1:]])
    largest = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    nearby = np.repeat(largest, size)[: len(power)]
    return np.maximum(nearby / max(float(median(nearby[own])), np.finfo(float).tiny), 1.0)


def _tied(motion: Array, own: Mask, at: NDArray[np.intp]) -> bool:
    """Whether these samples, each just before a knock, are where the motion (n, 2 c) or its rate of change is strong:
    along one axis, or altogether.

    The share p of the samples with more motion is uniform between 0 and 1 at a random time, so that - 2 sum ln p of
    independent times is chi-squared with two degrees of freedom for each (Fisher 1932).
    """
    sizes = [*np.abs(motion).T, *(np.linalg.norm(part, axis=1) for part in np.split(motion, 2, axis=1))]
    more = [1.0 - (np.searchsorted(np.sort(size[own]), size[at]) - 0.5) / np.count_nonzero(own) for size in sizes]
    statistic = max(-2.0 * float(np.log(p).sum()) for p in more)
    return bool(len(at)) and statistic > chi2_quantile(1.0 - TIED_BY_CHANCE / len(sizes), 2.0 * len(at))


def _runs(away: Array, longest_pause: int) -> list[tuple[int, int]]:
    """[first, stop) of each run of samples beyond KNOCK_SD robust SDs, with its flanks; `away` (n,) is in these SDs.
    Pauses of so many samples do not end a run."""
    at = np.flatnonzero(away > KNOCK_SD)
    if not len(at):
        return []
    cuts = np.flatnonzero(np.diff(at) > longest_pause + 1)
    calm = np.concatenate([[-1], np.flatnonzero(away <= FLANK_SD), [len(away)]])
    first = calm[np.searchsorted(calm, at[np.append(0, cuts + 1)]) - 1] + 1
    stop = calm[np.searchsorted(calm, at[np.append(cuts, len(at) - 1)])]
    return list(zip(first.tolist(), stop.tolist(), strict=True))
