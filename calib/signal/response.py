"""The response of the sensor over that of the reference: ln h(i omega) = -lag i omega + sum over k of c_k (i omega)^k.

The c_k are real: they are the cumulants of the impulse response between the two instruments. A low-pass filter of first
order at omega_0 has c_k = (-1)^k / (k omega_0^k). A corner omega_0 below the motion, as AC-coupled instruments have,
gives the same terms in powers of omega_0 / (i omega): those of a high-pass filter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.signal.band import convolved

Complex = NDArray[np.complex128]
POWERS = (2, 3, 4, 5, 6)  # fixed beforehand: if the data chose the number of terms, u would be too small
BELOW = (-1, -2, -3, -4)  # where an instrument is AC-coupled and nobody states its corner
ALL_POWERS = (*POWERS, *BELOW)
LOWER = 5.0  # times the corner of an AC-coupled instrument: the motion's lower end from which on the terms explain it
NEARER = 4.0  # times the corner: from there on the priors allow for the fourth term of a filter of first order
ALLOWED = 1.2  # times the corner that the data have shown: a larger one is looked at again
BELOW_UNIT = 0.2  # unit of a term below, in that of a filter of first order: its prior covers filters of order 4
EDGE = 2.0  # cycles at the lower end of the motion, over which the terms below act
UNSEEN = 0.45  # times the lower end of the motion: where the terms below begin to act; they do in full at twice that
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
    """The terms c_k in s^k of a response, in the order of ALL_POWERS, and the ends in Hz of the motion that told.

    Without terms below the motion there are as many as POWERS, and the lower end does not matter.
    """

    terms: tuple[float, ...] = (0.0,) * len(POWERS)
    to_hz: float = 0.0
    from_hz: float = 0.0

    @property
    def is_flat(self) -> bool:
        """Whether both instruments respond alike."""
        return not any(self.terms)

    @property
    def modest(self) -> Response:
        """The same with terms so small that the instruments differ by no more than LARGEST in the motion: the first
        estimates, from a linear equation, may be much too large."""
        size = float(np.abs(self.at(np.linspace(self.from_hz, self.to_hz, 50))).max())
        return self if size <= LARGEST else replace(self, terms=tuple(c * LARGEST / size for c in self.terms))

    @property
    def without_slight_below(self) -> Response:
        """The same without its terms below the motion if these hardly matter: they are left to the estimate, because
        a filter for them costs the ends of a recording."""
        slight = self.from_hz and np.abs(self.below_at(np.array([self.from_hz])))[0] < NEAR
        return Response(self.terms[: len(POWERS)], self.to_hz) if slight else self

    @property
    def rounded(self) -> Response:
        """The same to 0.1 %: a filter for it serves many windows."""
        unit = in_units(self.to_hz, self.from_hz / LOWER)[: len(self.terms)]
        return replace(self, terms=tuple((np.round(np.array(self.terms) / unit * ROUNDED) / ROUNDED * unit).tolist()))

    @property
    def reach_s(self) -> float:
        """How far its filter reaches to each side, in s."""
        if self.is_flat:
            return 0.0
        return (CYCLES + 1.0) / self.to_hz + (EDGE / self.from_hz if self.from_hz else 0.0)

    def at(self, frequency_hz: Array) -> Complex:
        """ln h at these frequencies, without the lag."""
        return np.asarray(by_term(2.0 * np.pi * frequency_hz, len(self.terms)) @ np.array(self.terms))

    def below_at(self, frequency_hz: Array) -> Complex:
        """What the terms below the motion add to ln h."""
        own = by_term(2.0 * np.pi * frequency_hz, len(self.terms))[..., len(POWERS) :]
        return np.asarray(own @ np.array(self.terms[len(POWERS) :]))


FLAT = Response()


@lru_cache(maxsize=16)
def in_units(to_hz: float, corner_hz: float = 0.0) -> Array:
    """The terms that a low-pass filter of first order at `to_hz` has, without their signs: (5,), or (9,) with those of
    an AC-coupled instrument with the corner `corner_hz`, times BELOW_UNIT. Read-only."""
    above = [1.0 / (k * (2.0 * np.pi * to_hz) ** k) for k in POWERS]
    below = [BELOW_UNIT / -k * (2.0 * np.pi * corner_hz) ** -k for k in BELOW] if corner_hz else []
    units = np.array([*above, *below])
    units.flags.writeable = False
    return units


def attenuating(frequency_hz: float) -> Array:
    """(5,) the terms of a response that attenuates by a factor of e at this frequency: that in s^2 alone."""
    return np.asarray(np.eye(1, len(POWERS))[0] / (2.0 * np.pi * frequency_hz) ** 2)


@dataclass(frozen=True, slots=True)
class ResponseModel:
    """Which terms of a response are unknowns: those of a motion up to `to_hz`, and those below it, where `from_hz` says
    where it begins. `one_frequency`: the motion has only that of `to_hz`, which tells |h| alone. `seen_corner_hz`: the
    corner below the motion that the data have shown, where it is nearer than a NEARER-th of `from_hz`."""

    to_hz: float = 0.0
    from_hz: float = 0.0
    one_frequency: bool = False
    seen_corner_hz: float = 0.0

    @property
    def powers(self) -> int:
        """How many powers of the frequency the terms have: 5, or 9 with those below the motion."""
        return len(ALL_POWERS if self.from_hz else POWERS)

    @property
    def corner_hz(self) -> float:
        """The corner whose terms are the scale of the priors of those below the motion."""
        return max(self.from_hz / LOWER, self.seen_corner_hz)

    def nearer(self, found: Response) -> ResponseModel | None:
        """The same for an instrument whose corner is nearer to the motion than the priors allow for, as the response
        that was found shows; None where they allow for it."""
        if not self.from_hz:
            return None
        seen_hz = abs(found.terms[ALL_POWERS.index(-1)]) / (2.0 * np.pi)
        allowed_hz = max(self.from_hz / NEARER, ALLOWED * self.seen_corner_hz)
        return replace(self, seen_corner_hz=seen_hz) if seen_hz > allowed_hz else None

    @property
    def unknowns(self) -> dict[str, Array]:
        """By name, the terms (5,) or (9,) of one unit of each unknown."""
        if self.one_frequency:
            return {"attenuation": attenuating(self.to_hz)}  # -ln |h| there
        units = np.diag(in_units(self.to_hz, self.corner_hz))
        return {f"response_{power}": unit for power, unit in zip(ALL_POWERS, units, strict=False)}


NO_MOTION = ResponseModel()  # no motion is known yet


def by_term(omega: Array, count: int = len(POWERS)) -> Complex:
    """(i omega)^k (..., count) for angular frequencies (...,): the derivatives of ln h by the first `count` terms.

    At 0 Hz the terms below the motion count as 0: the instrument that is not AC-coupled is meant there.
    """
    s = 1j * np.asarray(omega)  # products are three times as fast as complex powers
    square = s * s
    fourth = square * square
    found = [square, square * s, fourth, fourth * s, fourth * square]  # in the order of POWERS
    if count > len(POWERS):
        inverse = np.divide(1.0, s, out=np.zeros_like(s), where=s != 0.0)
        found += [inverse**-k for k in ALL_POWERS[len(POWERS) : count]]
    return np.stack(found, axis=-1)


def passed(u: Array, rate_hz: float, response: Response) -> Array:
    """u (n, m) as an instrument with this response shows it: 1 at 0 Hz.

    Rows within the filter's length of an end or of a missing sample (NaN) are NaN.
    """
    if response.is_flat or not response.to_hz > 0.0:
        return u
    above = response.terms[: len(POWERS)]
    if response.from_hz:
        u = _passed_below(u, rate_hz, response)
    if not any(above):
        return u
    step = max(1, int(rate_hz / (SPACED * response.to_hz)))
    taps = _taps(Response(above, response.to_hz), rate_hz / step)
    spread = np.zeros((len(taps) - 1) * step + 1)
    spread[::step] = taps
    return convolved(u, spread)


def _passed_below(u: Array, rate_hz: float, response: Response) -> Array:
    """u (n, m) passed through the terms below the motion; NaN within EDGE cycles of an end or of a missing sample."""
    out = np.full(u.shape, np.nan)
    whole = np.isfinite(u).all(axis=1)
    edges = np.flatnonzero(np.diff(whole.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    lost = int(np.ceil(EDGE * rate_hz / response.from_hz))
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(lost) + 0.5) / lost)
    for first, stop in edges.tolist():
        if stop - first <= 2 * lost:
            continue
        tapered = u[first:stop] - u[first:stop].mean(axis=0)
        tapered[:lost] *= rise[:, None]
        tapered[-lost:] *= rise[::-1, None]
        frequency_hz: Array = np.fft.rfftfreq(len(tapered), 1.0 / rate_hz).astype(np.float64)
        acting_hz = np.maximum(frequency_hz, UNSEEN * response.from_hz)
        share = np.minimum(np.log2(acting_hz / (UNSEEN * response.from_hz)), 1.0)
        moves = (0.5 - 0.5 * np.cos(np.pi * share)) * np.expm1(response.below_at(acting_hz))
        added = np.fft.irfft(moves[:, None] * np.fft.rfft(tapered, axis=0), len(tapered), axis=0)
        out[first + lost : stop - lost] = (u[first:stop] + added)[lost:-lost]
    return out


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
