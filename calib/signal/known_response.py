"""The known response of a sensor over that of its reference: divided out of the data, not estimated from them.

The reference's acceleration is filtered to what the sensor makes of it, before anything is estimated. Windows with
bands and without them, of files and of streams, are then made of the same samples. The delay of the filters stays in
the data: it is part of the lag, whose prior has it as its mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib.model import Array
from calib.signal.band import convolved
from calib.signal.known_filters import Complex, Delay, Filter, Flat, filter_of
from calib.signal.response import POWERS, by_term, in_units

REACHES_S = tuple(float(0.04 * 2.0 ** (0.5 * k)) for k in range(15))  # of the filter to each side: the first that is
RIGHT = 1e-4  # of h
LARGEST = 4.0  # times by which a signal is amplified: more of it would be noise
ROLLED = (0.7, 1.0)  # of half the rate, where resampling ends anyway, or of where the reference is hardly seen any more
LINES = 64  # of a response, to which terms are fitted
# What mounts add of which nobody states anything: a resonance at so many times the upper end of the motion.
MOUNT = 10.0
MOST_LEFT = 0.15  # of ln |h|, as standard uncertainty; with more, no terms explain it, and S counts as unknown
LAST = 0.94  # of the upper end of the motion: the middle of its last band
UNEVEN = 2.0  # times by which terms explain less where the motion has not the same power at all frequencies
TINY = 1e-9


@dataclass(frozen=True, slots=True)
class KnownResponse:
    """The filters of the sensor and of the reference; None where nobody states any."""

    sensor: tuple[Filter, ...] | None = None
    reference: tuple[Filter, ...] | None = None

    @property
    def is_stated(self) -> bool:
        """Whether anything is stated."""
        return self.sensor is not None or self.reference is not None

    @property
    def is_complete(self) -> bool:
        """Whether the filters of both are stated. Who states a delay alone says nothing of the size."""
        return all(of is not None and any(not isinstance(f, Delay) for f in of) for of in (self.sensor, self.reference))

    @property
    def is_flat(self) -> bool:
        """Whether there is nothing to divide out: no filter that changes a size or a shape."""
        return all(isinstance(one, Delay | Flat) for one in self._all)

    @property
    def group_delay_s(self) -> float:
        """By how much the sensor's filters delay more than the reference's, at 0 Hz."""
        late_s, reference_late_s = (sum(f.group_delay_s for f in of or ()) for of in (self.sensor, self.reference))
        return late_s - reference_late_s

    def of_sensor(self, frequency_hz: Array) -> Complex:
        """What the sensor's filters make of a motion at these frequencies, 1 at 0 Hz, their group delay taken out."""
        own = self.sensor or ()
        late_s = sum(f.group_delay_s for f in own)
        at = _product(own, frequency_hz) / _product(own, np.zeros(1))
        return np.asarray(at * np.exp(2j * np.pi * late_s * frequency_hz))

    def sensor_size(self, frequency_hz: float) -> float:
        """|h| of the sensor's filters at one frequency."""
        return float(np.abs(self.of_sensor(np.array([frequency_hz])))[0])

    def ratio(self, frequency_hz: Array) -> Complex:
        """The sensor's response over the reference's, the difference of their group delays taken out."""
        ratio = _product(self.sensor or (), frequency_hz) / _product(self.sensor or (), np.zeros(1))
        below = _not_0(_product(self.reference or (), frequency_hz))
        return np.asarray(ratio / below * np.exp(2j * np.pi * self.group_delay_s * frequency_hz))

    def reach_s(self, rate_hz: float) -> float:
        """How far its filter reaches to each side, in s."""
        return 0.0 if self.is_flat else len(_taps(self, _rounded(rate_hz))) // 2 / rate_hz

    @property
    def most_reach_s(self) -> float:
        """The largest `reach_s` at any rate."""
        return 0.0 if self.is_flat else REACHES_S[-1]

    def passed(self, u: Array, rate_hz: float) -> Array:
        """The reference's samples u (n, m) as the sensor shows them, but for the lag.

        Rows within the reach of an end or of a missing sample (NaN) are NaN.
        """
        return u if self.is_flat else convolved(u, _taps(self, _rounded(rate_hz)))

    def noise(self, band_hz: float, rate_hz: float) -> float:
        """By how much the filter raises the rms of white noise up to a frequency."""
        if self.is_flat:
            return 1.0
        taps = _taps(self, _rounded(rate_hz))
        size = 2 * len(taps)
        passed = np.abs(np.fft.rfft(taps, size))[: max(1, round(band_hz / rate_hz * size))]
        return float(np.sqrt(np.mean(passed**2)))

    def u_response(self, to_hz: float) -> float:
        """Standard uncertainty of the terms of what is left (calib.signal.response), in units of those of a low-pass
        filter at the upper end of the motion; inf where the filters of one instrument are not stated, or not known so
        far."""
        return _remaining_u(self, to_hz)[0] if self._covers(to_hz) else math.inf

    def u_beside_terms(self, to_hz: float) -> float:
        """Relative standard uncertainty of S where no such terms up to a frequency explain all that is left."""
        return _remaining_u(self, to_hz)[1] if self._covers(to_hz) else 0.0

    def u_size(self, frequency_hz: float) -> float:
        """Relative standard uncertainty of what is left at one frequency; inf as in `u_response`."""
        return _u_size(self._all, frequency_hz) if self._covers(frequency_hz) else math.inf

    def of_reference(self, frequency_hz: float) -> tuple[float, float]:
        """The share of the reference in ln |h| of what is left at a frequency, by what is stated of both, and the
        relative standard uncertainty of the sensor's share.

        Where the filters of one are not stated, all is the sensor's.
        """
        if not self._covers(frequency_hz):
            return 0.0, 0.0
        u, of_reference = (_u_size(of or (), frequency_hz) for of in (self.sensor, self.reference))
        both = math.hypot(u, of_reference)
        return (of_reference**2 / both**2, u * of_reference / both) if both else (0.0, 0.0)

    @property
    def _all(self) -> tuple[Filter, ...]:
        return (*(self.sensor or ()), *(self.reference or ()))

    def _covers(self, frequency_hz: float) -> bool:
        return self.is_complete and all(frequency_hz <= f.to_hz for f in self._all)


UNKNOWN = KnownResponse()


def known_response_of(sensor: Sequence[str] | None, reference: Sequence[str] | None) -> KnownResponse:
    """The filters that lines of text state; None or no line: nobody states any. Raises ValueError."""
    return KnownResponse(*(tuple(map(filter_of, lines)) if lines else None for lines in (sensor, reference)))


def _product(filters: Sequence[Filter], frequency_hz: Array) -> Complex:
    found = np.ones(len(frequency_hz), dtype=complex)
    for one in filters:
        found = found * one.at(frequency_hz)
    return found


def _changes(filters: Sequence[Filter], frequency_hz: Array) -> list[Complex]:
    """By filter: what ln h changes by if its frequencies are larger by their standard uncertainty."""
    return [
        np.asarray(np.log(one.at(frequency_hz / (1.0 + one.u_scale)) / _not_0(one.at(frequency_hz))))
        for one in filters
        if one.u_scale
    ]


def _u_size(filters: Sequence[Filter], frequency_hz: float) -> float:
    """Relative standard uncertainty of |h| at a frequency."""
    changes = [abs(float(np.expm1(change[0].real))) for change in _changes(filters, np.array([frequency_hz]))]
    return math.hypot(*changes, *(one.u_size for one in filters))


def _not_0(h: Complex) -> Complex:
    return np.where(np.abs(h) < TINY, TINY, h)


@lru_cache(maxsize=16)
def _remaining_u(known: KnownResponse, to_hz: float) -> tuple[float, float]:
    """What `u_response` and `u_beside_terms` are where all is stated."""
    frequency_hz = np.linspace(0.0, LAST * to_hz, LINES + 1)[1:]
    omega, unit = 2.0 * np.pi * frequency_hz, in_units(to_hz)
    moves = np.column_stack([np.ones(LINES), 1j * omega, by_term(omega) * unit])  # of S, of the lag, of the terms
    both = np.vstack([moves.real, moves.imag])
    own = 2.0 * in_units(MOUNT * to_hz)[POWERS.index(2)] / unit[POWERS.index(2)]
    squares, beside, near = np.full(len(POWERS), own**2), 0.0, False
    scale = np.abs(both).max(axis=0)
    for change in _changes(known._all, frequency_hz):
        near |= bool(np.abs(change.real).max() > MOST_LEFT)
        bent = np.concatenate([change.real, np.unwrap(change.imag)])
        found, *_ = np.linalg.lstsq(both / scale, bent, rcond=None)
        squares += (found / scale)[2:] ** 2
        beside += (UNEVEN * float(found[0])) ** 2
    squares += sum(f.u_size**2 for f in known._all) / (unit * (2.0 * np.pi * to_hz) ** np.array(POWERS)) ** 2
    return float(np.sqrt(squares.max())), 1.0 if near else math.sqrt(beside)


def _rounded(rate_hz: float) -> float:
    """Rates of a clock differ by a few millionths from window to window: one filter serves them all."""
    return float(f"{rate_hz:.5g}")


@lru_cache(maxsize=8)
def _taps(known: KnownResponse, rate_hz: float) -> Array:
    """Taps (2 half + 1,) of a filter that is the ratio up to `ROLLED`, and changes no more above."""
    size = 1 << math.ceil(math.log2(4.0 * REACHES_S[-1] * rate_hz))
    frequency_hz: Array = np.fft.rfftfreq(size, 1.0 / rate_hz).astype(np.float64)
    first, last = (share * _usable_hz(known, frequency_hz) for share in ROLLED)
    beyond = np.clip((frequency_hz - first) / (last - first), 0.0, 1.0)
    # The frequency whose ratio is taken: it stops halfway, without a corner.
    halting = first + (last - first) * (0.5 * beyond + np.sin(np.pi * beyond) / (2.0 * np.pi))
    ratio = known.ratio(np.where(beyond > 0.0, halting, frequency_hz))
    phase = np.unwrap(np.angle(ratio)) * (0.5 + 0.5 * np.cos(np.pi * beyond))
    whole = np.fft.fftshift(np.fft.irfft(np.abs(ratio) * np.exp(1j * phase), size))
    kept, middle, half = frequency_hz <= first, size // 2, 1
    for reach_s in REACHES_S:
        half = min(int(np.ceil(reach_s * rate_hz)), middle - 1)
        ends = np.minimum(2.0 * (1.0 - np.abs(np.arange(-half, half + 1)) / (half + 1.0)), 1.0)
        taps = whole[middle - half : middle + half + 1] * (0.5 - 0.5 * np.cos(np.pi * ends))
        padded = np.fft.ifftshift(np.pad(taps, (middle - half, size - middle - half - 1)))
        if (np.abs(np.fft.rfft(padded) - ratio) < RIGHT * np.maximum(np.abs(ratio), 1.0))[kept].all():
            break
    taps.flags.writeable = False
    return taps


def _usable_hz(known: KnownResponse, frequency_hz: Array) -> float:
    """Up to where the reference's filters leave a part of 1 / LARGEST of the motion, and somewhat beyond a table; half
    the rate at most."""
    weak = np.flatnonzero(np.abs(_product(known.reference or (), frequency_hz)) < 1.0 / LARGEST)
    tables_hz = min(one.to_hz for one in known._all) / ROLLED[0]
    return min(float(frequency_hz[weak[0] if weak.size else -1]), tables_hz)
