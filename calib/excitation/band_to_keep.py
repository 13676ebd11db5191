"""The band to which sensor and reference are limited alike, and the noise of the reference in it."""

from __future__ import annotations

import numpy as np

from calib.excitation.detection import moving_share
from calib.excitation.turning import feels_gravity
from calib.model import U_NOISE, Array
from calib.signal.band import (
    STOP_BAND,
    UNFOLDED,
    band_above_noise,
    folds,
    noise_in_bands,
    power_share_above,
    quietest,
)
from calib.signal.instrument import Instrument
from calib.signal.resampling import BAND, DIFFERENTIATED_BAND_HZ, differentiated_band_hz

NOISE_MATTERS = 1.4e-5  # of the motion's power: a filter against less of it would cost its ends for nothing
# Times its band: the equivalent bandwidth of calib.signal.band.lowpass for white noise, and for white noise that was
# differentiated once, twice and three times, most of which is in the filter's edge.
FILTER_BANDS = (1.197, 1.201, 1.206, 1.213)
FILTER_BAND = FILTER_BANDS[0]
# 1 % of gravity. A reference that moves by more beside a sensor does not rest.
LEAST_MOTION_MPS2 = 0.1
TOO_FAST = 0.01  # of the power of the reference: what interpolation loses of so little does not show
AS_FAST = 0.9  # of the sensor's rate; two devices of one nominal rate differ by less
# Power over that of the quietest window: with more, motion is in the noise; from MOSTLY on it is most of it, and the
# share that the sensor shows, which is right to a tenth or so, leaves nothing, or several times the noise.
BESIDE_MOTION, MOSTLY = 1.5, 5.0
# Of what looks like noise and is all motion, the power that still counts as noise. It moves nothing. But without noise
# the bands of a window reach further than with it, and those of the filter's edge show another response.
STAYS = 1e-4


def band_to_keep(
    raw: Array,
    u: Array,
    V: Array,
    instrument: Instrument,
    rates_hz: tuple[float, float],
    widest_hz: Array,
    to_hz: float | None,
    together: Array,
    most: Array,
) -> tuple[float | None, Array, float]:
    """Where to limit both signals, None where that gains nothing; the reference's noise (2, m) in what is left, and the
    relative standard uncertainty of its power.

    `rates_hz`: of the reference and of the sensor. `widest_hz` (2,): the bands of the noise in u and du/dt that
    interpolation leaves (calib.signal.resampling.Resampled). `to_hz` as in Settings. `together` (k, 3 + m): V and u at
    the same times. What looks like white noise of the reference, and the sensor shows as well, is motion. Where motion
    fills the spectrum, the noise is between none and all that is left where it moves least. `most` (m,): most_noise of
    Settings.
    """
    rate_hz, derivatives, m = rates_hz[0], instrument.derivatives, raw.shape[1]
    found_hz, density = band_above_noise(raw, rate_hz)
    stated = instrument.noise / np.sqrt(0.5 * rate_hz)
    density = np.maximum(density, stated)
    if derivatives:
        widest_hz = np.minimum(DIFFERENTIATED_BAND_HZ, widest_hz)
    unlimited = noise_in_bands(instrument.known.noise(float(widest_hz[0]), rate_hz) * density, widest_hz, derivatives)
    whole = u[np.isfinite(u).all(axis=1)]  # one missing sample of the reference makes some of them NaN
    power = np.var(whole, axis=0).max(initial=0.0) if len(whole) else 0.0
    noisy = np.max(unlimited[0] ** 2, initial=0.0) > NOISE_MATTERS * power
    if noisy and found_hz is not None and len(together):
        beyond_hz = found_hz, BAND * min(rates_hz)
        moves = moving_share(together[:, 3:], together[:, :3], rates_hz[1], beyond_hz, derivatives)
        density = np.maximum(_of_quieter(density, density * np.sqrt(np.maximum(1.0 - moves, STAYS)), most), stated)
    u_noise = U_NOISE
    if found_hz is None and not stated:
        all_left = quietest(raw, rate_hz)
        density, u_noise = _of_quieter(all_left, all_left / np.sqrt(2.0), most), 1.0 / np.sqrt(3.0)
        if (density == most).all():
            u_noise = U_NOISE
        unlimited = noise_in_bands(
            instrument.known.noise(float(widest_hz[0]), rate_hz) * density, widest_hz, derivatives
        )
    ends_hz = [found_hz if noisy else None, _limit_hz(raw, V, instrument, rates_hz, found_hz)]
    ends_hz.append(None if to_hz is None else to_hz / STOP_BAND)
    band_hz = min((end_hz for end_hz in ends_hz if end_hz is not None), default=None)
    if band_hz is None:
        return None, unlimited.reshape(2, m), u_noise
    noise_hz = np.minimum(np.array(FILTER_BANDS[derivatives : derivatives + 2]) * band_hz, widest_hz)
    noise = noise_in_bands(instrument.known.noise(float(noise_hz[0]), rate_hz) * density, noise_hz, derivatives)
    return band_hz, noise, u_noise


def _of_quieter(density: Array, beside_motion: Array, most: Array) -> Array:
    """(m,) the density of the noise: `beside_motion`, what of the `density` of this window is not motion as far as it
    tells by itself; no more than the `most` of other windows, and just that where it is motion mostly."""
    times = density**2 > BESIDE_MOTION * most**2, density**2 > MOSTLY * most**2
    return np.where(times[1], most, np.where(times[0], np.minimum(beside_motion, most), beside_motion))


def _limit_hz(
    raw: Array, V: Array, instrument: Instrument, rates_hz: tuple[float, float], found_hz: float | None
) -> float | None:
    """Where to limit both signals so that the sensor shows no motion that the reference cannot tell.

    None where the sensor shows no such motion. `found_hz`: the upper end of the reference's motion, None where nobody
    knows it. A reference as fast as the sensor, and not differentiated, tells all up to BAND of its rate; a faster one
    up to UNFOLDED of the sensor's.
    """
    rate_hz, sensor_rate_hz = rates_hz
    folded, slower = folds(rate_hz, sensor_rate_hz), rate_hz <= AS_FAST * sensor_rate_hz
    ends_hz = [UNFOLDED * sensor_rate_hz] if folded else []
    if instrument.derivatives or slower:
        ends_hz.append(differentiated_band_hz(rate_hz) if instrument.derivatives else BAND * rate_hz)
    elif found_hz is not None and not (folded and found_hz > ends_hz[0]):
        return None
    elif raw.shape[1] == 3 and feels_gravity(raw[np.isfinite(raw).all(axis=1)]):
        return None  # with a reference that feels gravity, rests count: a filter costs their ends
    elif not folded:
        share = power_share_above(raw, rate_hz, BAND * rate_hz)
        wide = share > TOO_FAST and share * float(np.nanvar(raw, axis=0).sum()) > LEAST_MOTION_MPS2**2
        return BAND * rate_hz / STOP_BAND if wide else None
    right_hz = min(ends_hz)
    felt_hz, _ = band_above_noise(V, sensor_rate_hz)
    if felt_hz is not None and felt_hz <= right_hz:
        return None
    return right_hz / STOP_BAND
