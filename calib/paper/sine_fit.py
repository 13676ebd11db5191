"""Sine approximation of ISO 16063 (three and four parameters): amplitude and phase without the leakage of an FFT.

    y(t) = Re(phasor exp(j 2 pi f (t - origin))) + constant

The phase is that at `origin_s`, the mean of the times: there its uncertainty is smallest, and independent of the
uncertainty of the frequency.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.model import Array

ComplexArray = NDArray[np.complex128]

# Frequencies tried near the highest FFT line, in lines. With one cycle in the record that line is off by up to one line
# (the constant and the negative frequency leak into it). Gauss-Newton converges from an eighth of a line away.
SCAN_LINES = np.arange(-4, 5) / 4
LEAST_LINES = 0.3  # less than a third of a cycle looks like a parabola, and its amplitude cannot be estimated
MAX_STEPS = 50
LONGEST_STEP_LINES = 0.25
CONVERGED_RAD = 1e-9  # change of the phase over the record, far below any noise
# Six cycles of 3 Hz as six times 333 samples at 1 kHz (Fig. 2) are 2 ms too short, 0.6 % of a cycle: they count as six.
CYCLE_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class SineFit:
    """One frequency in c signals. `phasor`, `constant`, `residual_sd`, `u_...` are (c,), in the signals' own unit.

    Uncertainties are standard ones for white residuals, the Cramér-Rao bound at the residual found; `u_frequency_hz` is
    0 where the frequency was given.
    """

    frequency_hz: float
    origin_s: float
    phasor: ComplexArray
    constant: Array
    residual_sd: Array
    u_amplitude: Array
    u_phase_rad: Array
    u_frequency_hz: float
    points: int

    @property
    def amplitude(self) -> Array:
        """(c,) peak values."""
        return np.abs(self.phasor)

    @property
    def phase_rad(self) -> Array:
        """(c,) phases of the cosine at `origin_s`."""
        return np.angle(self.phasor)

    def derivative(self, time_s: ArrayLike, order: int = 1) -> Array:
        """(n, c) time derivative of the fitted sines at `time_s` (n,); order 0 gives them without their constants."""
        omega = 2 * np.pi * self.frequency_hz
        turning = np.exp(1j * omega * (np.asarray(time_s, dtype=float) - self.origin_s))
        return np.asarray((turning[:, None] * self.phasor * (1j * omega) ** order).real)


def three_parameter(time_s: ArrayLike, signals: ArrayLike, frequency_hz: float) -> SineFit:
    """Amplitude, phase and constant of `signals` (n,) or (n, c) at a known frequency: linear least squares.

    `time_s` (n,) need not be evenly spaced. Raises ValueError on fewer than four points, values that are not finite,
    or a frequency that is not positive.
    """
    t, y = _checked(time_s, signals)
    if not (np.isfinite(frequency_hz) and frequency_hz > 0):
        raise ValueError(f"frequency must be positive, is {frequency_hz:.6g} Hz")
    origin = float(t.mean())
    design = _design(2 * np.pi * frequency_hz * (t - origin))
    return _fit(frequency_hz, 0.0, origin, _least_squares(design, y), len(t))


def four_parameter(time_s: ArrayLike, signal: ArrayLike, frequency_hz: float | None = None) -> SineFit:
    """Frequency, amplitude, phase and constant of one `signal` (n,) by Gauss-Newton (IEEE 1057, ISO 16063-41).

    The iteration starts at `frequency_hz`; if that is None, at the best frequency near the highest FFT line. Raises
    ValueError as `three_parameter` does, and if no sine of one frequency is found.
    """
    t, y = _checked(time_s, signal)
    if y.shape[1] != 1:
        raise ValueError(f"one signal has one frequency, {y.shape[1]} were given")
    if len(t) < 5:
        raise ValueError(f"four parameters need five points, there are {len(t)}")
    origin = float(t.mean())
    tau = t - origin
    line_hz = (len(t) - 1) / len(t) / float(np.ptp(t))
    f = coarse_frequency_hz(t, signal) if frequency_hz is None else frequency_hz
    for _ in range(MAX_STEPS):
        design = _design(2 * np.pi * f * tau)
        sine = _least_squares(design, y).x[:2, 0]
        slope = tau * (design[:, 1] * sine[0] - design[:, 0] * sine[1])  # of the model by 2 pi f
        solved = _least_squares(np.column_stack([design, slope]), y)
        step = float(solved.x[3, 0]) / (2 * np.pi)
        f += float(np.clip(step, -LONGEST_STEP_LINES * line_hz, LONGEST_STEP_LINES * line_hz))
        if f <= 0:
            break
        if abs(2 * np.pi * step) < CONVERGED_RAD * line_hz:
            u_frequency = float(np.sqrt(solved.spread[3, 3]) * solved.residual[0] / (2 * np.pi))
            return _fit(f, u_frequency, origin, solved, len(t))
    raise ValueError(f"no sine of one frequency in {len(t)} points over {np.ptp(t):.4g} s")


def coarse_frequency_hz(time_s: ArrayLike, signal: ArrayLike) -> float:
    """The frequency near the highest line of the spectrum of `signal` (n,) whose sine has the smallest residual.

    Raises ValueError as `three_parameter` does, and if the signal does not move.
    """
    t, y = _checked(time_s, signal)
    line_hz = (len(t) - 1) / len(t) / float(np.ptp(t))
    spectrum = np.abs(np.fft.rfft(y[:, 0] - y.mean()))
    if not spectrum.any():
        raise ValueError("the signal does not move")
    lines = np.unique(np.maximum(max(int(np.argmax(spectrum)), 1) + SCAN_LINES, LEAST_LINES))
    tau = t - t.mean()
    left = [_least_squares(_design(2 * np.pi * line_hz * line * tau), y).residual[0] for line in lines]
    return float(line_hz * lines[int(np.argmin(left))])


def acceleration(velocity: ArrayLike, frequency_hz: float) -> ComplexArray:
    """Phasor of the acceleration from that of the velocity: its amplitude by Eq. (12), its phase 90 deg ahead."""
    return np.asarray(2j * np.pi * frequency_hz * np.asarray(velocity), dtype=np.complex128)


def cycle_edges(time_s: ArrayLike, frequency_hz: float) -> NDArray[np.int64]:
    """(K + 1,) sample numbers of the K whole cycles in rising `time_s`: cycle k is [edges[k], edges[k + 1]).

    Raises ValueError where there is no whole cycle.
    """
    t = np.asarray(time_s, dtype=float)
    step = float(np.ptp(t)) / max(len(t) - 1, 1)  # a sample stands for the time up to the next one
    cycles = int((np.ptp(t) + step) * frequency_hz + CYCLE_TOLERANCE)
    if cycles < 1:
        raise ValueError(f"no whole cycle of {frequency_hz:.6g} Hz in {np.ptp(t):.4g} s")
    return np.asarray(np.searchsorted(t, t[0] + np.arange(cycles + 1) / frequency_hz - step / 2))


def _checked(time_s: ArrayLike, signals: ArrayLike) -> tuple[Array, Array]:
    t, y = np.asarray(time_s, dtype=float), np.asarray(signals, dtype=float)
    y = y[:, None] if y.ndim == 1 else y
    if t.ndim != 1 or y.ndim != 2 or len(t) != len(y):
        raise ValueError(f"shapes do not fit: times {t.shape}, signals {y.shape}")
    if len(t) < 4:
        raise ValueError(f"three parameters need four points, there are {len(t)}")
    if not (np.isfinite(t).all() and np.isfinite(y).all()):
        raise ValueError("times and signals must be finite")
    if np.ptp(t) <= 0:
        raise ValueError("all points have the same time")
    return t, y


def _design(phase_rad: Array) -> Array:
    """(n, 3): what real part, imaginary part of the phasor, and constant add to the signal."""
    return np.column_stack([np.cos(phase_rad), -np.sin(phase_rad), np.ones_like(phase_rad)])


class _Solution(NamedTuple):
    """Coefficients (p, c), (X'X)^-1 (p, p), residual SD (c,)."""

    x: Array
    spread: Array
    residual: Array


def _least_squares(design: Array, y: Array) -> _Solution:
    """Raises ValueError where the points do not carry the coefficients."""
    q, r = np.linalg.qr(design)
    if np.abs(np.diag(r)).min() < 1e-10 * np.abs(np.diag(r)).max():
        raise ValueError("the points do not carry a sine of this frequency")
    inverse = np.linalg.inv(r)
    x = inverse @ (q.T @ y)
    rest = y - design @ x
    freedom = len(y) - design.shape[1]
    return _Solution(x, inverse @ inverse.T, np.sqrt(np.einsum("nc,nc->c", rest, rest) / freedom))


def _fit(f: float, u_f: float, origin: float, solved: _Solution, points: int) -> SineFit:
    """Turn coefficients (3, c) into phasors, with the first-order uncertainties of modulus and argument."""
    x, spread, residual = solved
    phasor = x[0] + 1j * x[1]
    amplitude = np.abs(phasor)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = x[:2] / amplitude
        across = np.stack([-along[1], along[0]])
        u_along, u_across = (
            residual * np.sqrt(np.einsum("ic,ij,jc->c", way, spread[:2, :2], way)) for way in (along, across)
        )
        u_phase = u_across / amplitude
    return SineFit(f, origin, phasor, x[2].copy(), residual, u_along, u_phase, u_f, points)
