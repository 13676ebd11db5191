"""The response of the sensor over that of the reference: ln h(i omega) = -lag i omega + sum over k of c_k (i omega)^k.

The c_k are real: they are the cumulants of the impulse response between the two instruments. A low-pass filter of first
order at omega_0 has c_k = (-1)^k / (k omega_0^k).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.signal.band import convolved

Complex = NDArray[np.complex128]
POWERS = (2, 3, 4, 5, 6)  # fixed beforehand: if the data chose the number of terms, u would be too small
CYCLES = 3.0  # at the upper end of the motion, by which the taps of a filter reach to both sides
SPACED = 6.0  # times the upper end of the motion: the rate of taps that is enough for it
FINER = 8  # times the resolution of the taps, for the spectrum they are fitted to
WEIGHT_ABOVE = 1e-3  # of the filter above the motion, where it must only stay small
NEAR = 3e-3  # of ln h
LARGEST = 1.5  # of ln h in the motion: a resonance at 1.15 times its upper end; nearer ones are not told by this model
UNSETTLED = (
    "the response of sensor and reference over frequency does not settle: within the motion's band they differ too "
    "much, as at a filter's corner or a resonance; calibrate with motion at lower frequencies"
)
ROUNDED = 1024.0  # steps of a term, in units of that of a low-pass filter at the upper end of the motion
HELD = 1.1  # times the upper end of the motion: above it the polynomial is not continued


@dataclass(frozen=True, slots=True)
class Response:
    """The terms c_k in s^k of a response, in the order of POWERS, and the upper end in Hz of the motion that told."""

    terms: tuple[float, ...] = (0.0,) * len(POWERS)
    to_hz: float = 0.0

    @property
    def is_flat(self) -> bool:
        """Whether both instruments respond alike."""
        return not any(self.terms)

    def is_near(self, other: Response) -> bool:
        """Whether they differ by less than NEAR in the motion: what is left is estimated exactly."""
        frequency_hz = np.linspace(0.0, max(self.to_hz, other.to_hz), 50)
        return bool(np.abs(self.at(frequency_hz) - other.at(frequency_hz)).max() < NEAR)

    @property
    def modest(self) -> Response:
        """The same with terms so small that the instruments differ by no more than LARGEST in the motion: the first
        estimates, from a linear equation, may be much too large."""
        size = float(np.abs(self.at(np.linspace(0.0, self.to_hz, 50))).max())
        return self if size <= LARGEST else Response(tuple(c * LARGEST / size for c in self.terms), self.to_hz)

    @property
    def rounded(self) -> Response:
        """The same to 0.1 %: a filter for it serves many windows."""
        unit = in_units(self.to_hz)
        return Response(tuple((np.round(np.array(self.terms) / unit * ROUNDED) / ROUNDED * unit).tolist()), self.to_hz)

    @property
    def reach_s(self) -> float:
        """How far its filter reaches to each side, in s."""
        return 0.0 if self.is_flat else (CYCLES + 1.0) / self.to_hz

    def at(self, frequency_hz: Array) -> Complex:
        """ln h at these frequencies, without the lag."""
        return np.asarray(by_term(2.0 * np.pi * frequency_hz) @ np.array(self.terms))


FLAT = Response()


@lru_cache(maxsize=16)
def in_units(to_hz: float) -> Array:
    """(5,) the terms that a low-pass filter of first order at this frequency has, without their signs. Read-only."""
    units = np.array([1.0 / (k * (2.0 * np.pi * to_hz) ** k) for k in POWERS])
    units.flags.writeable = False
    return units


def attenuating(frequency_hz: float) -> Array:
    """(5,) the terms of a response that attenuates by a factor of e at this frequency: that in s^2 alone."""
    return np.asarray(np.eye(1, len(POWERS))[0] / (2.0 * np.pi * frequency_hz) ** 2)


def by_term(omega: Array) -> Complex:
    """(i omega)^k (..., 5) for angular frequencies (...,): the derivatives of ln h by the terms."""
    s = 1j * np.asarray(omega)  # products are three times as fast as complex powers
    square = s * s
    fourth = square * square
    return np.stack([square, square * s, fourth, fourth * s, fourth * square], axis=-1)  # in the order of POWERS


def passed(u: Array, rate_hz: float, response: Response) -> Array:
    """u (n, m) as an instrument with this response shows it: 1 at 0 Hz.

    Rows within the filter's length of an end or of a missing sample (NaN) are NaN.
    """
    if response.is_flat or not response.to_hz > 0.0:
        return u
    step = max(1, int(rate_hz / (SPACED * response.to_hz)))
    taps = _taps(response, rate_hz / step)
    spread = np.zeros((len(taps) - 1) * step + 1)
    spread[::step] = taps
    return convolved(u, spread)


@lru_cache(maxsize=8)
def _taps(response: Response, rate_hz: float) -> Array:
    """Taps (2 half + 1,) of a filter that is the response in the motion, and no more than alike above."""
    half = int(np.ceil(CYCLES * rate_hz / response.to_hz))
    frequency_hz = np.linspace(0.0, 0.5 * rate_hz, FINER * half + 1)
    end_hz = min(HELD * response.to_hz, 0.5 * rate_hz)
    beyond = np.clip((frequency_hz - end_hz) / max(0.5 * rate_hz - end_hz, 1e-9 * rate_hz), 0.0, 1.0)
    wanted = np.exp(response.at(np.minimum(frequency_hz, end_hz)) * (0.5 + 0.5 * np.cos(np.pi * beyond)))
    within = int(np.count_nonzero(frequency_hz <= HELD * response.to_hz))
    taps = _least_squares(half, within) @ np.concatenate([wanted.real, wanted.imag])
    taps.flags.writeable = False
    return np.asarray(taps)


@lru_cache(maxsize=4)
def _least_squares(half: int, within: int) -> Array:
    """(2 half + 1, 2 L) what makes taps of the real and imaginary parts wanted at L frequencies from 0 to half the
    rate, of which the first `within` have full weight."""
    frequency = np.linspace(0.0, 0.5, FINER * half + 1)
    weight = np.where(np.arange(len(frequency)) < within, 1.0, WEIGHT_ABOVE)
    rows = np.exp(-2j * np.pi * frequency[:, None] * np.arange(-half, half + 1)) * weight[:, None]
    return np.asarray(np.linalg.pinv(np.vstack([rows.real, rows.imag]), rcond=1e-6) * np.tile(weight, 2))
