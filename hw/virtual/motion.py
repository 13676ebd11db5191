"""Motion of the bench as a sum of sines: exact at any time, also after any linear filter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Acceleration a(t) = Re sum_c amplitude[c] exp(j 2 pi f_c t) in three channels.

    `frequency_hz` (C,), `amplitude_mps2` (C, 3) complex. Channels: along the slide, lateral to it, and along the
    direction in which Eqs. (9)-(11) count gravity.
    """

    frequency_hz: Array
    amplitude_mps2: ComplexArray

    def evaluate(self, t_s: Array, response: ComplexArray | None = None) -> tuple[Array, Array, Array]:
        """Displacement (m), velocity (m/s) and acceleration (m/s2), each (n, 3), at times `t_s` (n,).

        `response` (C,) is the complex frequency response of a filter that the motion passes through; None: no filter.
        """
        omega = 2 * np.pi * self.frequency_hz
        phase = np.multiply.outer(t_s, omega)
        basis = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)
        amplitude = self.amplitude_mps2 if response is None else self.amplitude_mps2 * response[:, None]
        s = 1j * omega[:, None]
        lines = np.concatenate([amplitude / s**2, amplitude / s, amplitude], axis=1)
        signals = basis @ np.concatenate([lines.real, -lines.imag])
        return signals[:, :3], signals[:, 3:6], signals[:, 6:]

    def with_transverse(self, lateral: float, vertical: float = 0.0) -> Motion:
        """The same motion with coherent transverse motion, given as fractions of the motion along the slide."""
        along = self.amplitude_mps2[:, 0]
        added = np.stack([np.zeros_like(along), lateral * along, vertical * along], axis=1)
        return replace(self, amplitude_mps2=self.amplitude_mps2 + added)


def sine(frequency_hz: float, amplitude_mps2: float, phase_rad: float = 0.0) -> Motion:
    """The motion of the paper: one sine along the slide, acceleration amplitude * sin(2 pi f t + phase)."""
    amplitude = np.zeros((1, 3), dtype=complex)
    amplitude[0, 0] = -1j * amplitude_mps2 * np.exp(1j * phase_rad)
    return Motion(np.array([frequency_hz]), amplitude)


def multisine(
    generator: np.random.Generator, low_hz: float = 1.0, high_hz: float = 8.0, lines: int = 8, peak_mps2: float = 5.0
) -> Motion:
    """Sum of sines of equal amplitude along the slide, with random phases; the peak of the sum is `peak_mps2`.

    Each line has a random frequency in its own part of the band. So no two lines are harmonics, and the motion does not
    repeat within some seconds.
    """
    frequency = low_hz + (high_hz - low_hz) * (np.arange(lines) + generator.uniform(0.2, 0.8, lines)) / lines
    amplitude = np.zeros((lines, 3), dtype=complex)
    amplitude[:, 0] = np.exp(2j * np.pi * generator.random(lines))
    motion = Motion(frequency, amplitude)
    # 60 s with 16 points per period of the highest line: the peak found is less than 2 % too low.
    grid = np.arange(0.0, 60.0, 1 / (16 * high_hz))
    peak = np.abs(motion.evaluate(grid)[2][:, 0]).max()
    return replace(motion, amplitude_mps2=amplitude * (peak_mps2 / peak))


def orbit(frequency_hz: float, amplitude_mps2: float) -> Motion:
    """Circular motion in the horizontal plane at one frequency."""
    shape = np.array([[1.0, -1.0j, 0.0]], dtype=np.complex128)
    return Motion(np.array([frequency_hz]), amplitude_mps2 * shape)


def ambient(
    generator: np.random.Generator,
    low_hz: float = 0.5,
    high_hz: float = 10.0,
    lines: int = 64,
    rms_mps2: float = 0.02,
) -> Motion:
    """Random tri-axial motion of a structure: independent lines in each of the three channels, of `rms_mps2` each."""
    frequency = low_hz + (high_hz - low_hz) * (np.arange(lines) + generator.uniform(0.2, 0.8, lines)) / lines
    weight = generator.normal(size=(lines, 3)) + 1j * generator.normal(size=(lines, 3))
    rms = np.sqrt((np.abs(weight) ** 2).sum(axis=0) / 2)
    return Motion(frequency, weight * (rms_mps2 / rms))
