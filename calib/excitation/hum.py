"""Lines of the mains that sensor and reference both show, and that are no motion: a ground loop hums in both.

Such a line is coherent, so that no search for noise finds it, but what the sensor shows of it has nothing to do with
what the reference shows. Where the line contradicts the rest of the motion, it is taken out of both by the same filter:
V = S a + Q holds for filtered signals as well. A motion at the frequency of the mains loses its line in this way, and
no other one.
"""

from __future__ import annotations

import numpy as np

from calib.model import Array
from calib.signal.band import convolved, hanning

MAINS_HZ, HARMONICS = (50.0, 60.0), 6
WITHIN = 0.01  # of the mains' frequency: grids keep theirs within 1 %
SHOWS = 100.0  # times the density of power beside it, and so much of the largest of its lines, in both devices
BESIDE_HZ = 2.0  # around a line, where the density beside it is found
LEAST_SHARE = 1e-4  # of the power of the rest: a weaker line moves no slope
CONTRADICTS = 0.25  # of the line's power that the rest of the motion does not explain
LEAST_REST = 0.1  # of the lines' power that the rest must have to judge them: a shaker at 50 Hz is no hum
REACH_S = 2.0  # of the filter to each side: it takes 0.5 Hz around a line
LEAST_S = 5.0 * REACH_S


def hum_hz(u: Array, V: Array, rate_hz: float) -> list[float]:
    """The frequencies in Hz of lines of the mains in u (n, m) and V (n, 3) that contradict the rest of the motion."""
    if len(u) < LEAST_S * rate_hz:
        return []
    columns = np.hstack([u, V])
    columns = np.nan_to_num(columns - np.nanmean(columns, axis=0))
    lines = np.fft.rfft(columns * hanning(len(u))[:, None], axis=0)
    hz: Array = np.fft.rfftfreq(len(u), 1.0 / rate_hz).astype(np.float64)
    m = u.shape[1]
    power = np.stack([np.sum(np.abs(lines[:, :m]) ** 2, axis=1), np.sum(np.abs(lines[:, m:]) ** 2, axis=1)])
    for mains_hz in MAINS_HZ:
        at_hz: list[float] = []
        for k in range(1, HARMONICS + 1):
            own_hz = _line(power, hz, k, mains_hz, rate_hz)
            if own_hz is not None and all(abs(own_hz - other_hz) > 1.0 / REACH_S for other_hz in at_hz):
                at_hz.append(own_hz)  # two of them may be aliased to one
        if not at_hz:
            continue
        within = np.any(np.abs(hz - np.array(at_hz)[:, None]) < 1.0 / REACH_S, axis=0)
        rest, seen = lines[~within], lines[within]
        if np.any(power[:, ~within].sum(axis=1) < LEAST_REST * power[:, within].sum(axis=1)):
            continue
        slopes = np.linalg.lstsq(_real(rest[:, :m]), _real(rest[:, m:]), rcond=None)[0]
        left = np.sum(np.abs(seen[:, m:] - seen[:, :m] @ slopes) ** 2)
        if left > CONTRADICTS * np.sum(np.abs(seen[:, m:]) ** 2):
            return at_hz
    return []


def without_lines(columns: Array, rate_hz: float, at_hz: list[float]) -> Array:
    """Samples (n, k) after a filter without phase shift that takes out lines; NaN near an end or a missing sample."""
    half = round(REACH_S * rate_hz)
    window, n = hanning(2 * half + 3)[1:-1], np.arange(-half, half + 1)
    mean, taps = np.nanmean(columns, axis=0), np.zeros(2 * half + 1)
    taps[half] = 1.0
    for hz in at_hz:
        taps -= 2.0 * window / window.sum() * np.cos(2.0 * np.pi * hz / rate_hz * n)
    return np.asarray(convolved(columns - mean, taps) + mean)


def _real(lines: Array) -> Array:
    """Rows of the real and of the imaginary parts: a real slope acts on both."""
    return np.vstack([lines.real, lines.imag])


def _line(power: Array, hz: Array, harmonic: int, mains_hz: float, rate_hz: float) -> float | None:
    """The frequency of a line at a multiple of the mains' frequency, as it is aliased; None where there is none.

    `power` (2, L) of reference and sensor at the frequencies `hz` (L,).
    """
    wanted = harmonic * mains_hz
    folded = abs((wanted + 0.5 * rate_hz) % rate_hz - 0.5 * rate_hz)
    near = np.flatnonzero(np.abs(hz - folded) < max(WITHIN * mains_hz, 2.0 / REACH_S))
    if not len(near) or folded < BESIDE_HZ or folded > 0.5 * rate_hz - BESIDE_HZ:
        return None
    at_hz = float(hz[near[np.argmax(power[:, near].prod(axis=0))]])
    own = np.abs(hz - at_hz) < 0.5 / REACH_S
    around = (np.abs(hz - at_hz) < BESIDE_HZ) & ~(np.abs(hz - at_hz) < 1.0 / REACH_S)
    shows = power[:, own].max(axis=1) > SHOWS * np.median(power[:, around], axis=1)
    matters = power[:, own].sum(axis=1) > LEAST_SHARE * power.sum(axis=1)
    return at_hz if (shows & matters).all() else None
