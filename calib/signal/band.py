"""The frequency band in which the reference's motion exceeds its noise, and one low-pass filter for both signals.

When a structure moves weakly, the derivative of the reference's noise masks the coefficient on du/dt, and with it the
lag. Outside the band of the motion the signals contain only noise. Sensor and reference are therefore filtered to that
band by the same filter: V = S a + Q holds for the filtered signals as well, whatever the filter is.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from calib.model import Array
from calib.signal.holes import Mask, in_short_holes, short_holes_filled
from calib.signal.order_statistics import median

SEGMENT_S = 4.0  # length of a segment of a spectrum: lines 0.25 Hz apart, and many segments in a few minutes
LEAST_SEGMENTS = 8  # fewer segments give spectra that are too uncertain to choose a band
SIGNIFICANT = 6.0  # standard deviations by which a smoothed line must exceed the noise to count as motion
SMOOTHED = 5  # spectral lines in a moving average
MARGIN = 1.25  # the band ends a quarter above the highest line that holds motion
FEWEST_LINES = 64  # samples in a segment
TINY = 1e-300
WIDEST = 0.35  # of the sampling rate: above this a filter would remove hardly any noise
ROLLS_OFF, QUIETEST = 0.4, 0.05  # of the sampling rate; of the lines
OF_NOISE = 0.88  # times the density of white noise: what `quietest` says of noise alone, in windows of a minute
STOP_BAND_DB = 66.0
STOP_BAND = 1.5  # times the band that the filter passes
HALVED = 1.25  # times the band that the filter passes: where half of an amplitude is left
# Of a slower sampling rate: what is sampled so keeps its motion up to here, and nothing is folded below.
UNFOLDED = 0.4
FOLDED_DB = 100.0  # a ripple of 1e-5: the sensor's samples do not pass this filter
# At the lower end, the length of Hann's window whose mean is subtracted twice: half of an amplitude is left there.
SLOW_CYCLES = 1.3


def band_above_noise(x: Array, rate_hz: float) -> tuple[float | None, Array]:
    """Upper end (Hz) of the band in which x (n, m) has more power than its white noise, and that noise (m,).

    Rows of x with missing samples are NaN. The noise is an amplitude density in the unit of x per root Hz. The motion
    must occupy less than half of the spectrum. The band is None, and the noise zero, if the motion is wider than that,
    if no line exceeds the noise, or if x is too short.
    """
    m = x.shape[1]
    size = min(int(SEGMENT_S * rate_hz), len(x) // LEAST_SEGMENTS)
    if size < FEWEST_LINES:
        return None, np.zeros(m)
    x, segments = _bridged(x), 0
    while 2 * segments < LEAST_SEGMENTS:  # more of the shorter segments are free of missing samples
        powers, segments = _spectra(x, size)
        if 2 * segments < LEAST_SEGMENTS and (size := size // 2) < FEWEST_LINES:
            return None, np.zeros(m)
    window = hanning(size)
    floor = _floor(powers[:, 1:-1], segments)
    ratio = np.convolve(
        np.mean(powers / np.maximum(floor, TINY)[:, None], axis=0), np.ones(SMOOTHED) / SMOOTHED, "same"
    )
    moving = np.flatnonzero(ratio[SMOOTHED:-SMOOTHED] > 1.0 + SIGNIFICANT / np.sqrt(m * SMOOTHED * segments))
    if not len(moving):
        return None, np.zeros(m)
    band_hz = MARGIN * float(moving[-1] + SMOOTHED) * rate_hz / size
    if band_hz >= WIDEST * rate_hz:
        return None, np.zeros(m)
    # The first median included the lines of the motion: if they are a fifth of all, it is 8 % above the noise alone.
    floor = _floor(powers[:, int(np.ceil(band_hz * size / rate_hz)) : -1], segments)
    return band_hz, np.sqrt(floor / (0.5 * rate_hz * np.sum(window**2)))


def quietest(x: Array, rate_hz: float) -> Array:
    """(m,) the amplitude density of x (n, m) where it is quietest: its white noise is no more than that. In the unit of
    x per root Hz; 0 if x is too short. Above ROLLS_OFF of the rate, the filters of most devices begin."""
    size = min(int(SEGMENT_S * rate_hz), len(x) // LEAST_SEGMENTS)
    if size < FEWEST_LINES:
        return np.zeros(x.shape[1])
    powers, segments = _spectra(_bridged(x), size)
    lines = powers[:, 1 : int(ROLLS_OFF * size)]
    smooth = np.array([np.convolve(own, np.ones(SMOOTHED) / SMOOTHED, "valid") for own in lines])
    floor = np.quantile(smooth, QUIETEST, axis=1) if segments else np.zeros(x.shape[1])
    return np.sqrt(floor / (0.5 * rate_hz * np.sum(hanning(size) ** 2)))


def most_noise(x: Array, rate_hz: float) -> Array:
    """(m,) the amplitude density of x (n, m) beside its motion, or where it is quietest: its white noise is no more
    than that, and as much where nothing else is there. In the unit of x per root Hz; 0 if x is too short."""
    band_hz, density = band_above_noise(x, rate_hz)
    return density if band_hz is not None else quietest(x, rate_hz) / OF_NOISE


def power_share_above(x: Array, rate_hz: float, from_hz: float) -> float:
    """The share of the power of x (n, m) above a frequency; 0 if x is too short to tell."""
    size = min(int(SEGMENT_S * rate_hz), len(x) // LEAST_SEGMENTS)
    if size < FEWEST_LINES:
        return 0.0
    powers, segments = _spectra(_bridged(x), size)
    total = float(powers.sum())
    return float(powers[:, int(np.ceil(from_hz * size / rate_hz)) :].sum()) / total if segments and total > 0.0 else 0.0


def _floor(powers: Array, segments: int) -> Array:
    """(m,) mean power of the noise in spectral lines (m, k); fewer than half of the lines may hold motion as well.

    A line's power is the mean of `segments` exponential variables: its median is its mean times 1 - 1 / (3 segments).
    """
    return np.asarray(median(powers) / (1.0 - 1.0 / (3.0 * segments)))


def _bridged(x: Array) -> Array:
    """x (n, m) with short holes interpolated linearly, which needs no band and changes a spectrum very little.

    A straight line across two samples has an error of 3 % of a motion at a twelfth of the sampling rate. In longer
    holes all channels are NaN.
    """
    missing: Mask = np.asarray(np.isnan(x).any(axis=1))
    if not missing.any() or missing.all():
        return x
    out, index = x.copy(), np.arange(len(x))
    for k in range(x.shape[1]):
        out[missing, k] = np.interp(index[missing], index[~missing], x[~missing, k])
    out[missing & ~in_short_holes(missing)] = np.nan
    return out


def noise_in_bands(density: Array, bands_hz: Array, derivatives: int) -> Array:
    """(2, m) rms of a reference's white noise: in the acceleration (m/s2) up to the first of two frequencies, in its
    derivative (m/s3) up to the second one.

    `density` (m,) is the noise of the measured quantity per root Hz; `derivatives` is how often that quantity was
    differentiated to give the acceleration: 0 for acceleration, 1 for velocity, 2 for displacement.
    """
    k = np.array([derivatives, derivatives + 1])
    powers = (2.0 * np.pi) ** (2 * k) * bands_hz ** (2 * k + 1) / (2 * k + 1)
    return np.asarray(np.sqrt(powers)[:, None] * density)


def lowpass(x: Array, rate_hz: float, band_hz: float) -> Array:
    """x (n, k), one sample per row, through a low-pass filter without phase shift (FIR, Kaiser's window).

    Its gain is 1 to 0.1 % up to `band_hz`, and at most -66 dB from 1.5 `band_hz` on. Rows closer than `lowpass_lost` to
    an end of x, or to a NaN, are NaN.
    """
    half = lowpass_lost(rate_hz, band_hz)
    n = np.arange(-half, half + 1)
    cut = 1.25 * band_hz / rate_hz
    taps = 2.0 * cut * np.sinc(2.0 * cut * n) * _kaiser(2 * half + 1)
    taps /= taps.sum()
    return convolved(x, taps)


def unfolded(x: Array, rate_hz: float, slower_hz: float) -> Array:
    """x (n, k) without what sampling at the rate `slower_hz` folds to frequencies up to UNFOLDED times that rate.

    Its gain is 1 to 1e-5 up to there, and at most -100 dB where the folding begins. x as it is where nothing is folded
    so far. Rows within half of the filter of an end or of a missing sample (NaN) are NaN.
    """
    if not folds(rate_hz, slower_hz):
        return x
    wide = (1.0 - 2.0 * UNFOLDED) * slower_hz / rate_hz  # from the end of the band to where the folding begins
    half = int(np.ceil((FOLDED_DB - 8.0) / (2.285 * 2.0 * np.pi * wide) / 2.0))
    taps = np.sinc(slower_hz / rate_hz * np.arange(-half, half + 1)) * np.kaiser(
        2 * half + 1, 0.1102 * (FOLDED_DB - 8.7)
    )
    return convolved(x, taps / taps.sum())


def folds(rate_hz: float, slower_hz: float) -> bool:
    """Whether sampling at `slower_hz` folds frequencies of samples at `rate_hz` to UNFOLDED times the slower rate."""
    return (1.0 - UNFOLDED) * slower_hz < 0.5 * rate_hz


def without_slow(x: Array, rate_hz: float, from_hz: float) -> Array:
    """x (n, k), one sample per row, through a high-pass filter without phase shift; the means of the columns stay.

    Half of an amplitude is left at `from_hz`, 6 % at half of that. Rows closer than SLOW_CYCLES cycles of it to an end
    of x, or to a NaN, are NaN.
    """
    half = max(1, round(0.5 * SLOW_CYCLES * rate_hz / from_hz))
    mean = hanning(2 * half + 3)[1:-1]
    once = -mean / mean.sum()
    once[half] += 1.0
    whole = np.nansum(x, axis=0) / np.maximum(np.isfinite(x).sum(axis=0), 1)
    return np.asarray(convolved(x - whole, np.convolve(once, once)) + whole)


def convolved(x: Array, taps: Array) -> Array:
    """x (n, m) convolved with symmetrically placed taps (2 half + 1,).

    Rows within `half` of an end or of a missing sample (NaN) are NaN.
    """
    half = len(taps) // 2
    if len(x) <= 2 * half:
        return np.full_like(x, np.nan)
    out: Array = np.full(x.T.shape, np.nan).T
    size = _fast_length(len(x) + 2 * half)
    absent = np.isnan(x)
    missing = absent.any(axis=1)
    held = np.where(absent, 0.0, x) if missing.any() else x
    filtered = np.fft.irfft(np.fft.rfft(np.ascontiguousarray(held.T), size) * np.fft.rfft(taps, size), size)
    out[half:-half] = filtered[:, 2 * half : len(x)].T
    if missing.any():
        near = np.convolve(missing, np.ones(2 * half + 1), "same") > 0.5
        out[near] = np.nan
    return out


def without_short_holes(raw: Array, V: Array, rates_hz: tuple[float, float]) -> tuple[Array, Array, Mask, Mask]:
    """The reference's samples and the sensor's with their short holes filled, and which of each were.

    Nothing is filled where the band of the motion is not known in both. The sensor may feel a wider band, and weak
    motion that only the reference tells from noise.
    """
    signals, bands_hz = (raw, V), []
    if any(np.isnan(x).any() for x in signals):
        found_hz = (band_above_noise(x, rate_hz)[0] for x, rate_hz in zip(signals, rates_hz, strict=True))
        bands_hz = [band_hz for band_hz in found_hz if band_hz is not None]
    if len(bands_hz) < len(signals):
        return raw, V, np.zeros(len(raw), dtype=bool), np.zeros(len(V), dtype=bool)
    raw, raw_filled = short_holes_filled(raw, rates_hz[0], bands_hz[0])
    V, filled = short_holes_filled(V, rates_hz[1], max(bands_hz))
    return raw, V, raw_filled, filled


@lru_cache(maxsize=16)
def _fast_length(least: int) -> int:
    """Smallest 2^a 3^b 5^c not below `least`: an FFT whose length has a large prime factor is several times slower."""
    odd = (3**b * 5**c for b in range(4) for c in range(4))
    return min(int(k) << max(-(-least // int(k)) - 1, 0).bit_length() for k in odd)


def lowpass_lost(rate_hz: float, band_hz: float) -> int:
    """Number of samples that the filter loses at each end: half its length, by Kaiser's formula for a transition
    width of band_hz / 2."""
    return int(np.ceil((STOP_BAND_DB - 8.0) / (2.285 * np.pi * band_hz / rate_hz) / 2.0))


@lru_cache(maxsize=4)
def _kaiser(size: int) -> Array:
    """Kaiser's window (size,) for STOP_BAND_DB, cached and read-only as `hanning`."""
    window = np.kaiser(size, 0.1102 * (STOP_BAND_DB - 8.7))
    window.flags.writeable = False
    return window


@lru_cache(maxsize=4)
def hanning(size: int) -> Array:
    """Hann's window (size,). It is cached and read-only, because every window of data needs the same one."""
    window = np.hanning(size)
    window.flags.writeable = False
    return window


def _spectra(x: Array, size: int) -> tuple[Array, int]:
    """Power spectra (m, size // 2 + 1) of x (n, m), averaged over whole Hann-windowed segments, and their number.

    Segments with missing samples are left out: samples from both sides of a gap, joined, would show a jump.
    """
    whole = len(x) // size
    parts = np.ascontiguousarray(x[: whole * size].reshape(whole, size, -1).swapaxes(1, 2))
    parts = parts[~np.isnan(parts).any(axis=(1, 2))]
    lines = np.fft.rfft((parts - parts.mean(axis=2, keepdims=True)) * hanning(size), axis=2)
    return np.sum(lines.real**2 + lines.imag**2, axis=0) / max(len(parts), 1), len(parts)
