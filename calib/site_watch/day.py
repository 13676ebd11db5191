"""The hours of a day condensed to one value for each channel of each sensor.

A channel is one of six numbers of a band: the log amplitude of the outputs x, y, z (half the log of the band's power
without noise), and the normalised cross powers xy, xz, yz (cross power over the product of the amplitudes).

In each hour the level of a band and axis is free, since nobody knows how the structure was excited. It is taken out by
a median over the sensors of what each differs from its own median of the day (Tukey's median polish); what remains is
averaged with outliers clipped. So a sensor that misses some hours does not move the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.model import Array

HOURS = 24
FEWEST_HOURS = 6  # of a day, for a channel to count
LEAST_RATIO = 1.5  # power of the signal over that of the noise, in a band and hour that count
U_NOISE = 0.05  # relative standard uncertainty of the noise floor of a day
U_FLOOR = 0.003  # of the log amplitude of a whole day, however little noise there is; of fewer hours it is more
CLIP = 3.0  # standard deviations
MAD = 1.4826  # standard deviation over the median of absolute deviations, of a normal distribution
ROUNDS = 2  # of the median polish
WIDTH = 10.0**0.05 - 10.0**-0.05  # of a third octave, over its nominal centre (IEC 61260-1)
PAIRS = (0, 0, 1), (1, 2, 2)  # xy, xz, yz
LAGS_H = -3, -2, -1, 1, 2, 3  # by which a clock is sought to be off
LAG_LEFT = 0.05  # part of the squares of a sensor's hours that another clock must leave, at most, to be told


@dataclass(frozen=True, slots=True, eq=False)
class Hours:
    """Hourly results of n sensors in B bands; NaN where there is none.

    `hour` (H,): hours since 1970 in UTC. `power`, `cross` (H, n, B, 3): mean squares of x, y, z and real cross
    powers xy, xz, yz, (m/s²)². `noise_psd` (H, n, 3), (m/s²)²/Hz. `temperature_degc` (H, n). `mean_mps2` (H, n, 3):
    mean of the outputs, None where no result tells it. `frequency` (H, n, B, 3): log of the peak frequency over the
    centre of the band, None where no result tells it.
    """

    hour: Array
    power: Array
    cross: Array
    noise_psd: Array
    temperature_degc: Array
    mean_mps2: Array | None = None
    frequency: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SelfTests:
    """The self-test of each sensor on a day; NaN where there was none.

    `log_response` (n, 3): log of the size of the response of x, y, z; `u` (n, 3): its standard uncertainty from the
    scatter of this night; `u_supply` (n, 3): by the supply, which all axes of a sensor share. `temperature_degc` (n,).
    """

    log_response: Array
    u: Array
    u_supply: Array
    temperature_degc: Array


@dataclass(frozen=True, slots=True, eq=False)
class Day:
    """One day. `value`, `u` (n, B, 6): the channels with the standard uncertainty that their noise gives; NaN and inf
    where a channel does not count. `level` (B, 3): log amplitude of the level. `log_noise` (n, 3): half the log of the
    noise floor. `temperature_degc`: the median of all sensors; NaN where none tells one. `mean_mps2` (n, 3): the median
    of the hours. `self_tests`: None where no sensor has one. `frequency` (n, B, 3): log of the peak frequency over the
    centre of the band, NaN where too few hours tell it. `lag_h` (n,): hours by which the clock of a sensor is late
    against those of most others; its channels then do not count. None where no clock is off. `contrast` (n, 3): log
    amplitude of x, y, z against the level in the quieter half of the hours, less that in the louder half, mean of the
    bands; None where the hours are not known. `frequency_contrast` (n, B, 3): that of the log of the peak frequency.
    """

    number: int
    value: Array
    u: Array
    level: Array
    log_noise: Array
    temperature_degc: float
    mean_mps2: Array | None = None
    self_tests: SelfTests | None = None
    frequency: Array | None = None
    lag_h: Array | None = None
    contrast: Array | None = None
    frequency_contrast: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Visits:
    """Sensors that got another calibration on a day, by a bench, a visit or a reference.

    `there` (n,): which. `found` (n, 3): relative change of the sensitivity of x, y, z since the calibration before,
    which was found then; NaN where it is not known. `u` (n,): standard uncertainty of it.
    """

    there: NDArray[np.bool_]
    found: Array
    u: Array

    @classmethod
    def unknown(cls, there: NDArray[np.bool_]) -> Visits:
        """Visits of which is not known what they found."""
        return cls(there, np.full((len(there), 3), np.nan), np.full(len(there), np.inf))


def day_of(hours: Hours, band_hz: Array) -> Day:
    """Condense the hours of one UTC day. `band_hz` (B,): nominal centres of the bands."""
    floor = hours.noise_psd[:, :, None, :] * (WIDTH * band_hz)[:, None]
    signal = hours.power - floor
    with np.errstate(invalid="ignore", divide="ignore"):
        counts = (signal > LEAST_RATIO * floor) & np.isfinite(signal)
        signal = np.where(counts, signal, np.nan)
        amplitude = 0.5 * np.log(signal)
        cross = hours.cross / np.sqrt(signal[..., PAIRS[0]] * signal[..., PAIRS[1]])
        ratio = floor / signal
    cross = np.where(np.abs(cross) <= 1.5, cross, np.nan)
    lag_h = _lag_h(amplitude)
    late = lag_h != 0.0
    amplitude[:, late], counts[:, late], cross[:, late] = np.nan, False, np.nan
    present = np.sum(counts, axis=0)  # (n, B, 3)
    value, level, rest = _polished(amplitude)
    loud = level > _median(level)
    both = np.sum(np.isfinite(cross), axis=0)
    number = np.concatenate([present, both], axis=2)
    told = number >= FEWEST_HOURS
    u_noise = 0.5 * U_NOISE * np.nan_to_num(_mean(ratio))
    u_noise = np.concatenate([u_noise, u_noise[..., PAIRS[0]] + u_noise[..., PAIRS[1]]], axis=2)
    u = np.sqrt(U_FLOOR**2 * HOURS / np.maximum(number, 1) + u_noise**2)
    values = np.concatenate([value, _clipped_mean(cross)], axis=2)
    temperatures = hours.temperature_degc[np.isfinite(hours.temperature_degc)]
    return Day(
        int(hours.hour[0]) // HOURS,
        np.where(told, values, np.nan),
        np.where(told, u, np.inf),
        _mean(level),
        0.5 * np.log(_positive(_median(hours.noise_psd))),
        float(np.median(temperatures)) if temperatures.size else np.nan,
        None if hours.mean_mps2 is None else _median(hours.mean_mps2),
        frequency=None
        if hours.frequency is None
        else np.where(late[:, None, None], np.nan, _frequency(hours.frequency)),
        lag_h=lag_h if late.any() else None,
        contrast=_mean(np.moveaxis(_contrast(rest, loud), 1, 0)),
        frequency_contrast=None
        if hours.frequency is None
        else np.where(late[:, None, None], np.nan, _contrast(hours.frequency, loud)),
    )


def _lag_h(amplitude: Array) -> Array:
    """Whole hours by which each sensor (n,) indicates the level of the others late, from (H, n, B, 3); 0 where nothing
    says so.

    The level changes from hour to hour by much more than a sensor differs from it. Where a clock is k hours late, a
    sensor differs at hour h by level[h - k] - level[h].
    """
    own = amplitude - _median(amplitude)
    level = _median(np.moveaxis(own, 1, 0))  # (H, B, 3)
    away, level = (_mean(np.moveaxis(one.reshape(*one.shape[:-2], -1), -1, 0)) for one in (own - level[:, None], level))
    lag_h, least = np.zeros(away.shape[1]), LAG_LEFT * _mean(np.square(away))
    for k in LAGS_H:
        shown = np.full(len(level), np.nan)
        shown[max(k, 0) : len(level) + min(k, 0)] = level[max(-k, 0) : len(level) - max(k, 0)]
        moved = away - (shown - level)[:, None]
        left = np.where(np.isfinite(moved).sum(axis=0) >= FEWEST_HOURS, _mean(np.square(moved)), np.inf)
        better = left < least
        lag_h, least = np.where(better, k, lag_h), np.where(better, left, least)
    return lag_h


def _frequency(hours: Array) -> Array:
    """The peak frequency of a day (n, B, 3), from its hours."""
    enough = np.sum(np.isfinite(hours), axis=0) >= FEWEST_HOURS
    return np.where(enough, _clipped_mean(hours), np.nan)


def _polished(amplitude: Array) -> tuple[Array, Array, Array]:
    """The value of each sensor (n, B, 3) against the level, the level (H, B, 3), and what is left without it, from
    (H, n, B, 3)."""
    own = _median(amplitude)
    own = own - _median(own)
    for _ in range(ROUNDS):
        level = _median(np.moveaxis(amplitude - own, 1, 0))  # (H, B, 3)
        rest = amplitude - level[:, None]
        own = _median(rest)
    return _clipped_mean(rest), level, rest


def _contrast(values: Array, loud: NDArray[np.bool_]) -> Array:
    """Mean of the quiet hours less that of the loud ones (n, B, 3), from `values` (H, n, B, 3) and `loud` (H, B, 3)."""
    known = np.isfinite(values)
    quiet, loud = ~loud[:, None] & known, loud[:, None] & known
    enough = np.minimum(quiet.sum(axis=0), loud.sum(axis=0)) >= FEWEST_HOURS // 2
    apart = _mean(np.where(quiet, values, np.nan)) - _mean(np.where(loud, values, np.nan))
    return np.where(enough, apart, np.nan)


def _clipped_mean(values: Array) -> Array:
    """Mean over the first axis, with what is far from the median brought to CLIP standard deviations."""
    centre = _median(values)
    reach = CLIP * MAD * _median(np.abs(values - centre))
    return _mean(np.clip(values, centre - reach, centre + reach))


def _median(values: Array) -> Array:
    """Median over the first axis without NaN; NaN where there is nothing. Quicker than numpy's for short axes."""
    ordered = np.sort(np.moveaxis(values, 0, -1), axis=-1)  # NaN come last
    number = np.sum(np.isfinite(ordered), axis=-1)
    low, high = np.maximum(number - 1, 0) // 2, np.minimum(number // 2, len(values) - 1)
    both = np.take_along_axis(ordered, np.stack([low, high], axis=-1), axis=-1)
    return np.where(number > 0, both.mean(axis=-1), np.nan)


def _mean(values: Array) -> Array:
    """Mean over the first axis without NaN; NaN where there is nothing."""
    there = np.isfinite(values)
    number = there.sum(axis=0)
    total = np.where(there, values, 0.0).sum(axis=0)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def _positive(values: Array) -> Array:
    return np.where(values > 0.0, values, np.nan)
