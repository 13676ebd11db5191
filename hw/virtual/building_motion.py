"""Random motion of a building for some minutes: modes in a broad band, one level, along one or all directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.virtual.response import Response

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
# Grid points per period of the upper end of the band: interpolation by cubic pieces is then accurate to 3e-6.
POINTS_A_PERIOD = 32
RAMP_S = 0.4


@dataclass(frozen=True, slots=True)
class BuildingSpectrum:
    """Spectrum of a building's motion: modes (natural frequency and damping ratio) above a flat part."""

    low_hz: float = 0.5
    high_hz: float = 15.0
    modes: tuple[tuple[float, float], ...] = ((1.3, 0.02), (3.9, 0.02), (8.4, 0.03))
    flat: float = 0.3  # fraction of the power that is spread evenly over the band

    def density(self, frequency_hz: Array) -> Array:
        """Power density of the acceleration at `frequency_hz`, up to a factor; all modes have equal power."""
        inside = (frequency_hz >= self.low_hz) & (frequency_hz <= self.high_hz)
        width = self.high_hz - self.low_hz
        density = np.full_like(frequency_hz, self.flat / width)
        for natural_hz, damping in self.modes:
            half = damping * natural_hz
            line = half / np.pi / ((frequency_hz - natural_hz) ** 2 + half**2)
            density += (1 - self.flat) / len(self.modes) * line
        return np.asarray(density * inside)


class BuildingMotion:
    """Acceleration (m/s2) within `span_s`; it fades in and out within RAMP_S and is zero outside.

    `shape` (C, 3): each of the C rows is a direction with its own random motion of `level_mps2` rms. The imaginary part
    of a complex row moves a quarter of a period ahead of the real part. `response` is that of a device at frequencies
    (k,): its output is given in place of the motion.
    """

    def __init__(
        self,
        random: np.random.Generator,
        band: BuildingSpectrum,
        span_s: tuple[float, float],
        level_mps2: float,
        shape: Array | ComplexArray,
        response: Response | None = None,
    ) -> None:
        self._start_s, self._stop_s = start_s, stop_s = span_s
        self._rate_hz = POINTS_A_PERIOD * band.high_hz
        points = _fast_length(int(np.ceil((stop_s - start_s) * self._rate_hz)) + 2)
        frequency_hz: Array = np.arange(points // 2 + 1) * np.float64(self._rate_hz / points)
        lines = np.sqrt(band.density(frequency_hz))[:, None] * (
            random.standard_normal((len(frequency_hz), len(shape)))
            + 1j * random.standard_normal((len(frequency_hz), len(shape)))
        )
        lines *= level_mps2 * points / np.sqrt(2 * np.sum(np.abs(lines) ** 2, axis=0))
        if response is not None:
            moves = lines.any(axis=1)  # the band alone, which is a sixteenth of the lines
            lines[moves] *= response(frequency_hz[moves])[:, None]
        if np.iscomplexobj(shape):
            lines, shape = np.hstack([lines, 1j * lines]), np.vstack([shape.real, shape.imag])
        self._shape = np.asarray(shape, dtype=np.float64)
        self._value = np.fft.irfft(lines, points, axis=0)
        self._slope = np.fft.irfft(lines * (2j * np.pi * frequency_hz[:, None] / self._rate_hz), points, axis=0)

    def at(self, time_s: Array) -> Array:
        """Acceleration (n, 3) at times (n,)."""
        place = np.clip((time_s - self._start_s) * self._rate_hz, 0.0, len(self._value) - 2.0)
        cell = place.astype(np.int64)
        x = place - cell
        # Cubic Hermite pieces: value and slope are exact at the grid points.
        fade = _step((time_s - self._start_s) / RAMP_S) * _step((self._stop_s - time_s) / RAMP_S)
        a, b = (1 + 2 * x) * (1 - x) ** 2 * fade, x * (1 - x) ** 2 * fade
        c, d = x**2 * (3 - 2 * x) * fade, x**2 * (x - 1) * fade
        moved = np.zeros((len(time_s), 3))
        for k, direction in enumerate(self._shape):
            value, slope = self._value[:, k], self._slope[:, k]
            one = a * value[cell] + b * slope[cell] + c * value[cell + 1] + d * slope[cell + 1]
            for axis in np.flatnonzero(direction):
                moved[:, axis] += direction[axis] * one
        return moved


def _step(progress: Array) -> Array:
    p = np.clip(progress, 0.0, 1.0)
    return np.asarray(p * p * (3 - 2 * p))


def _fast_length(least: int) -> int:
    """The smallest 2^a 3^b 5^c of at least `least`."""
    candidates = ((1 << a) * (1, 3, 9)[b] * (1, 5, 25)[c] for a in range(1, 30) for b in range(3) for c in range(3))
    return min(n for n in candidates if n >= least)
