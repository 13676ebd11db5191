"""Has a natural frequency changed beyond what temperature and excitation do to it?

The peak frequency of a window (calib.signal.spectra) is a ratio of powers of one output, so no sensitivity moves it. A
mode has one frequency at all sensors: where several see it move, the structure has changed. What a frequency does by
itself is common to all sensors too. So their steps are joined, and the scatter of the joint residual of each day says
how far they, and the days, depend on each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.distributions import NORMAL
from calib.model import Array
from calib.signal.spectra import THIRD_OCTAVE
from calib.site_watch.steps import PRIOR_DEGREES
from calib.site_watch.watch import U_FREQUENCY, SiteWatch, pooled

FALSE_ALARMS_PER_YEAR = 0.25  # of a whole site, at most, where the model of the scatter holds
MISFIT = 1.5  # factor of u for what the norm does not fit over seasons, such as frost
U_UNSEEN = 1e-3  # by which what nobody measures may move a frequency for long: water, ice, load. Assumed
PART_UNSEEN = 1.0  # the same as a part of the scatter of a day: where modes share a window, their loads move its peak
# Part of the scatter between sensors that enters the test; all of it enters U. Sensors that see other modes in the
# window too show a smaller change, so that they differ where the change is true.
PART_APART = 0.5
LEAST_VARIANCE = 1e-12  # of a channel over U_FREQUENCY², where its days do not scatter at all
WALK_PER_ROOT_DAY = 5e-5  # standard uncertainty of its own walk after a day: 0.1 % in a year
FEWEST_SENSORS = 3  # that must see the mode
FARTHEST = 0.55  # third octaves from the centre of its window: beyond it a mode stands nearer to that of the next one
PARTS = 4  # of a window: sensors whose peaks lie in other parts of it see other modes
PART_CONTRASTED = 0.1  # of a change: by how much quiet and loud hours may differ in it, with their U
SAME = 1.05  # third octaves from the centre of a window within which a changed frequency moves that of the window
REACH = 0.06  # relative distance of a changed frequency from the edge of a band that it moves


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyChange:
    """A natural frequency near `hz` has changed by `size` (log) ± `u`. `squared` (k,): its squared statistic at each
    begin; `sensors`: how many see it, of those that see a peak there."""

    hz: float
    size: float
    u: float
    squared: Array
    sensors: tuple[int, int]
    statistic: float


@dataclass(frozen=True, slots=True, eq=False)
class Joined:
    """For each begin (k), window, axis and part of the window: `size`, `u` (k, B, 3, PARTS) of the step of the sensors
    whose peak lies in it; `statistic`: its size over u with and without the sensor that says most, the smaller one.
    `information`, `step` (k, n, B, 3) of each sensor; `part` (n, B, 3): in which part its peak lies. `contrast`,
    `u_contrast` (k, n, B, 3): by how much more it stepped in quiet hours than in loud ones; NaN where nothing says."""

    size: Array
    u: Array
    statistic: Array
    information: Array
    step: Array
    part: NDArray[np.int64]
    contrast: Array
    u_contrast: Array


def limit_of(bands: int, looks_per_year: float) -> float:
    """Standard deviations that no sound frequency may exceed."""
    return -NORMAL.inv_cdf(0.5 * FALSE_ALARMS_PER_YEAR / (3 * bands * PARTS * looks_per_year))


def joined(watch: SiteWatch, which: list[int], fewest: tuple[int, int], longest_days: float) -> Joined:
    """The steps at begins[k], k in `which`. `fewest` days before and since, for a channel to count; the walk is that of
    at most `longest_days`."""
    steps, shape = watch.frequencies, (*watch.shape[:2], 3)
    size, information, since = (part.reshape(-1, *shape) for part in steps.step(which))
    days = steps.days.reshape(shape)
    place = steps.beta[0].reshape(shape) / (FARTHEST * THIRD_OCTAVE)
    counts = (since >= fewest[1]) & (days - since >= fewest[0]) & (np.abs(place) < 1.0)
    variance = pooled(*steps.rest(), shape)
    explained = size**2 * information / (np.maximum(days, 1.0) + PRIOR_DEGREES)  # a step is no scatter
    variance = np.maximum(np.maximum(variance - explained, 0.2 * variance), LEAST_VARIANCE)
    information = np.where(counts, information / variance, 0.0)
    begins = [steps.begins[k] for k in which]
    ages = np.array([watch.day - begin + 1 for begin in begins], dtype=float)
    before = np.minimum([begin - steps.begins[0] for begin in begins], longest_days)
    walked = U_UNSEEN**2 + WALK_PER_ROOT_DAY**2 * (ages + before) / 3.0
    inflation = MISFIT**2 * watch.frequency_scatter.over(watch.day, begins).reshape(-1, *shape[1:])
    common = walked[:, None, None] + inflation * _inverse(information.sum(axis=1))
    part = np.clip((0.5 * PARTS * (place + 1.0)).astype(np.int64), 0, PARTS - 1)
    exact = np.where(counts, 1.0 / (U_FREQUENCY**2 * variance), 0.0)
    found = [_group(size, np.where(part == q, information, 0.0), exact, common) for q in range(PARTS)]
    told, u, statistic = (np.stack(each, axis=-1) for each in zip(*found, strict=True))
    return Joined(told, u, statistic, information, size, part, *_contrasts(watch, which, fewest))


def _contrasts(watch: SiteWatch, which: list[int], fewest: tuple[int, int]) -> tuple[Array, Array]:
    """Steps (k, n, B, 3) of the contrasts of the frequencies, and their u."""
    steps, shape = watch.frequency_contrasts, (*watch.shape[:2], 3)
    size, information, since = (part.reshape(-1, *shape) for part in steps.step(which))
    counts = (since >= fewest[1]) & (steps.days.reshape(shape) - since >= fewest[0]) & (information > 0.0)
    u = np.sqrt(pooled(*steps.rest(), shape) * _inverse(information))
    return np.where(counts, size, np.nan), np.where(counts, u, np.nan)


def _group(size: Array, information: Array, exact: Array, common: Array) -> tuple[Array, Array, Array]:
    """Size, u and statistic (k, B, 3) of the sensors that have information. `exact` (k, n, B, 3): the inverse variance
    of a day; `common` (k, B, 3): the variance that they share."""
    there, total, push = information > 0.0, information.sum(axis=1), information * size
    mean = push.sum(axis=1) * _inverse(total)
    apart = np.sum(information * np.square(size - mean[:, None]), axis=1) * _inverse(total)
    several = there.sum(axis=1)
    own = common + PART_UNSEEN**2 * several * _inverse(np.sum(np.where(there, exact, 0.0), axis=1))
    loudest = np.argmax(push * np.sign(mean)[:, None], axis=1)[:, None]
    others = total - np.take_along_axis(information, loudest, axis=1)[:, 0]
    rest = (mean * total - np.take_along_axis(push, loudest, axis=1)[:, 0]) * _inverse(others)
    agree = (several >= FEWEST_SENSORS) & (np.sign(rest) == np.sign(mean))
    least = [np.abs(size) / np.sqrt(own + _inverse(weight) + PART_APART**2 * apart)
             for size, weight in ((mean, total), (rest, others))]  # fmt: skip
    u = np.sqrt(np.where(total > 0.0, own + _inverse(total) + apart, np.inf))
    return mean, u, np.where(agree, np.minimum(*least), 0.0)


def _inverse(values: Array) -> Array:
    """1 over the values; 0 where these are 0."""
    return np.where(values > 0.0, 1.0 / np.where(values > 0.0, values, 1.0), 0.0)


def changed(watch: SiteWatch, found: Joined, limit: float) -> list[FrequencyChange]:
    """The frequencies that have changed, the surest first, each mode once, in the window that shows it best.

    That is the one with the largest statistic times the root of the share of sensors that see a peak there. Most
    sensors see a mode itself; where two modes share a window their mixture moves more, but at few sensors.
    """
    told: list[FrequencyChange] = []
    z = found.statistic
    best = z.max(axis=0)
    sees = (found.information.max(axis=0) > 0.0)[..., None] & (found.part[..., None] == np.arange(PARTS))
    order = np.where(best > limit, best * np.sqrt(sees.mean(axis=0)), 0.0)
    mean = watch.frequencies.beta[0].reshape(found.part.shape)
    for place in np.argsort(-order, axis=None)[: np.sum(best > limit)]:
        w, axis, q = np.unravel_index(place, best.shape)
        k = int(np.argmax(z[:, w, axis, q]))
        weight = np.where(found.part[:, w, axis] == q, found.information[k, :, w, axis], 0.0)
        size = float(found.size[k, w, axis, q])
        hz = float(watch.band_hz[w] * np.exp(np.sum(weight * mean[:, w, axis]) / weight.sum()))
        if _by_excitation(size, weight, found.contrast[k, :, w, axis], found.u_contrast[k, :, w, axis]):
            continue
        see = int(np.sum((weight > 0.0) & (found.step[k, :, w, axis] / size > 0.5)))
        if all(abs(np.log(watch.band_hz[w] / other.hz)) > SAME * THIRD_OCTAVE for other in told):
            u, sensors = float(found.u[k, w, axis, q]), (see, int(np.sum(weight > 0.0)))
            told.append(FrequencyChange(hz, size, u, z[:, w, axis, q] ** 2, sensors, float(best[w, axis, q])))
    return told


def _by_excitation(size: float, weight: Array, contrast: Array, u: Array) -> bool:
    """Whether quiet and loud hours of the sensors (n,) may have moved otherwise: a mode moves in all of them by one
    `size`; where modes share a window, their mixture follows what excites them."""
    known = np.isfinite(contrast) & (weight > 0.0)
    if not known.any():
        return False
    share = weight[known] / weight[known].sum()
    return abs(float(share @ contrast[known])) + 2.0 * float(share @ u[known]) > PART_CONTRASTED * abs(size)


def moved_bands(band_hz: Array, changes: list[FrequencyChange]) -> NDArray[np.bool_]:
    """(B,) third octaves in which a changed frequency lies, or nearly: they say nothing of sensitivities and shapes."""
    half = 10.0**0.05 * (1.0 + REACH)
    moved = np.zeros(len(band_hz), dtype=bool)
    for one in changes:
        moved |= (band_hz / half < one.hz) & (one.hz < band_hz * half)
    return moved
