"""The band in which a reference moves more than it is noisy, and a low-pass filter for sensor and reference alike.

At the level of a structure's own motion a reference's noise, differentiated, hides the coefficient on du/dt and with it
the lag. Outside the band of the motion there is nothing to be had but noise, so both signals are limited to it alike:
V = S a + Q stays true, whatever the filter.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from calib.model import Array

SEGMENT_S = 4.0  # of a spectrum: lines 0.25 Hz apart, and still many segments in some minutes
LEAST_SEGMENTS = 8  # of each kind, else the spectra are known too poorly to choose by
SIGNIFICANT = 6.0  # standard deviations of a smoothed line, of a hundred of them
SMOOTHED = 5  # lines
MARGIN = 1.25  # the filter passes all of the band and a quarter more
FEWEST_LINES = 64
TINY = 1e-300
SHORT_HOLE = 2  # samples; a straight line over them leaves 3 % of a motion at a twelfth of the rate
WIDEST = 0.35  # of the sampling rate: beyond, a filter has nothing left to take away
STOP_BAND_DB = 66.0
STOP_BAND = 1.5  # times the band that the filter passes


def band_above_noise(x: Array, rate_hz: float) -> tuple[float | None, Array]:
    """Upper end in Hz of where x (n, m) has more power than the white noise in it, and that noise (m,) per root Hz.

    Motion must leave more than half of the spectrum free. None where it does not, where nothing stands out, or where
    too little is known; the noise is zero then. NaN where samples are missing.
    """
    m = x.shape[1]
    size = min(int(SEGMENT_S * rate_hz), len(x) // LEAST_SEGMENTS)
    if size < FEWEST_LINES:
        return None, np.zeros(m)
    x, segments = _bridged(x), 0
    while 2 * segments < LEAST_SEGMENTS:  # of shorter ones more are without a hole
        spectra = [_spectrum([x[:, k : k + 1]], size) for k in range(m)]
        powers, segments = np.stack([power for power, _ in spectra]), spectra[0][1]
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
    # The median over all lines holds those of the motion: in a fifth of them it is 8 % above the noise alone.
    floor = _floor(powers[:, int(np.ceil(band_hz * size / rate_hz)) : -1], segments)
    return band_hz, np.sqrt(floor / (0.5 * rate_hz * np.sum(window**2)))


def _floor(powers: Array, segments: int) -> Array:
    """(m,) mean power of the noise in lines (m, k), a few of which may hold more than noise.

    A line's power is a mean of `segments` exponentials: its median is the mean but for one part in 3 segments.
    """
    return np.asarray(np.median(powers, axis=1) / (1.0 - 1.0 / (3.0 * segments)))


def _bridged(x: Array) -> Array:
    """x (n, m) with a straight line over holes of a sample or two, which spectra hardly see; longer ones all NaN."""
    missing = np.isnan(x).any(axis=1)
    if not missing.any() or missing.all():
        return x
    out, index = x.copy(), np.arange(len(x))
    for k in range(x.shape[1]):
        out[missing, k] = np.interp(index[missing], index[~missing], x[~missing, k])
    edges = np.flatnonzero(np.diff(missing.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    for first, stop in edges[edges[:, 1] - edges[:, 0] > SHORT_HOLE].tolist():
        out[first:stop] = np.nan
    return out


def noise_in_band(density: Array, band_hz: float, derivatives: int) -> Array:
    """(2, m) rms of white noise of `density` (m,) per root Hz in the acceleration limited to `band_hz`, and in its
    derivative.

    `derivatives`: how many times what is so noisy was differentiated to give the acceleration.
    """
    turn = 2.0 * np.pi
    powers = [turn ** (2 * k) * band_hz ** (2 * k + 1) / (2 * k + 1) for k in (derivatives, derivatives + 1)]
    return np.asarray(np.sqrt(np.array(powers))[:, None] * density)


def lowpass(x: Array, rate_hz: float, band_hz: float) -> Array:
    """x (n, k), one sample a row, limited to `band_hz`: flat to 0.1 % up to it, 66 dB down from STOP_BAND times it on.

    No phase. Rows within `lowpass_lost` of an end, or of a NaN, are NaN.
    """
    half = lowpass_lost(rate_hz, band_hz)
    n = np.arange(-half, half + 1)
    cut = 1.25 * band_hz / rate_hz
    taps = 2.0 * cut * np.sinc(2.0 * cut * n) * np.kaiser(2 * half + 1, 0.1102 * (STOP_BAND_DB - 8.7))
    taps /= taps.sum()
    if len(x) <= 2 * half:
        return np.full_like(x, np.nan)
    out: Array = np.full(x.T.shape, np.nan).T
    size = _fast_length(len(x) + 2 * half)
    held = np.ascontiguousarray(np.nan_to_num(x).T)
    filtered = np.fft.irfft(np.fft.rfft(held, size) * np.fft.rfft(taps, size), size)
    out[half:-half] = filtered[:, 2 * half : len(x)].T
    missing = np.isnan(x).any(axis=1)
    if missing.any():
        near = np.convolve(missing, np.ones(2 * half + 1), "same") > 0.5
        out[near] = np.nan
    return out


def _fast_length(least: int) -> int:
    """Smallest 2^a 3^b 5^c not below `least`: a length with a large prime in it takes several times as long."""
    odd = (3**b * 5**c for b in range(4) for c in range(4))
    return min(int(k) << max(-(-least // int(k)) - 1, 0).bit_length() for k in odd)


def lowpass_lost(rate_hz: float, band_hz: float) -> int:
    """Samples at each end for which the filter has no full support (Kaiser's length for a transition of band / 2)."""
    return int(np.ceil((STOP_BAND_DB - 8.0) / (2.285 * np.pi * band_hz / rate_hz) / 2.0))


@lru_cache(maxsize=4)
def hanning(size: int) -> Array:
    """Hann's window (size,), not to be written to: every window of data asks for the same one."""
    window = np.hanning(size)
    window.flags.writeable = False
    return window


def _spectrum(stretches: Sequence[Array], size: int) -> tuple[Array, int]:
    """Mean power (size // 2 + 1,) over channels, Hann-windowed whole segments of `size`, and their number."""
    window = hanning(size)[:, None]
    total, count = np.zeros(size // 2 + 1), 0
    for x in stretches:
        for start in range(0, len(x) - size + 1, size):
            part = x[start : start + size]
            if np.isnan(part).any():
                continue  # what lies on both sides of a hole, put together, would be a jump and no noise
            total += np.sum(np.abs(np.fft.rfft((part - part.mean(axis=0)) * window, axis=0)) ** 2, axis=1)
            count += 1
    return total / max(count, 1), count
