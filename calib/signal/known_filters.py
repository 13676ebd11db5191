"""Filters of an instrument that are known beforehand, each in one line of text, as `lowpass order=2 corner_hz=31`.

A filter is what its data sheet or its certificate says: h(f) of its indications, 1 at 0 Hz (a table: 1 where the
sensitivity of the certificate holds). How well it is known is part of it. Sources: Butterworth 1930; Hogenauer 1981
(decimators by moving means); ISO 16063-1 (complex sensitivity as magnitude and phase).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import get_type_hints

import numpy as np
from numpy.typing import NDArray

from calib.model import Array

Complex = NDArray[np.complex128]
HIGHEST_ORDER = 12
LOWEST_CORNER_HZ = 1.0  # a filter with a lower corner remembers longer than a window has samples to spare
MOST_POINTS, MOST_NUMBERS = 1e6, 10_000
FEWEST_ROWS = 2  # of a table
LARGEST_PCT = 50.0
BEYOND = 1.5  # times the last frequency of a table: from there on h is constant


@dataclass(frozen=True)
class Filter:
    """Base of all kinds; the names of the fields are those of the text."""

    def at(self, frequency_hz: Array) -> Complex:
        """h at these frequencies (n,), all from 0 on."""
        return np.ones(len(frequency_hz), dtype=complex)

    @property
    def group_delay_s(self) -> float:
        """Group delay at 0 Hz."""
        return 0.0

    @property
    def u_scale(self) -> float:
        """Relative standard uncertainty of its frequencies: the corner's, or that of the clock."""
        return 0.0

    @property
    def u_size(self) -> float:
        """Relative standard uncertainty of |h| apart from that, by frequency."""
        return 0.0

    @property
    def to_hz(self) -> float:
        """Up to which frequency it is known."""
        return math.inf


@dataclass(frozen=True)
class Flat(Filter):
    """An instrument that responds alike at all frequencies of the motion, but for `u_pct`."""

    u_pct: float = 0.0

    def __post_init__(self) -> None:
        _percent(u_pct=self.u_pct)

    @property
    def u_size(self) -> float:
        return self.u_pct / 100.0


@dataclass(frozen=True)
class Delay(Filter):
    """A pure delay."""

    delay_s: float

    def __post_init__(self) -> None:
        _within(0.0, 1.0, delay_s=self.delay_s)

    def at(self, frequency_hz: Array) -> Complex:
        return np.asarray(np.exp(-2j * np.pi * frequency_hz * self.delay_s))

    @property
    def group_delay_s(self) -> float:
        return self.delay_s


@dataclass(frozen=True)
class Highpass(Filter):
    """The filter of first order of an AC-coupled instrument, 3 dB down at its corner; 0 at 0 Hz.

    It is not divided out: `corner_apart` takes it out of the lines, and its corner is undone (calib.signal.corner).
    """

    corner_hz: float
    u_corner_pct: float = 10.0

    def __post_init__(self) -> None:
        _positive(corner_hz=self.corner_hz)
        _percent(u_corner_pct=self.u_corner_pct)

    def at(self, frequency_hz: Array) -> Complex:
        return np.asarray(frequency_hz / (frequency_hz - 1j * self.corner_hz))


@dataclass(frozen=True)
class Lowpass(Filter):
    """A Butterworth filter, 3 dB down at its corner; of first order where `order` is 1."""

    corner_hz: float
    order: float = 1.0
    u_corner_pct: float = 10.0

    def __post_init__(self) -> None:
        _within(LOWEST_CORNER_HZ, math.inf, corner_hz=self.corner_hz)
        _order(self.order)
        _percent(u_corner_pct=self.u_corner_pct)

    @property
    def _poles(self) -> Complex:
        """(order,) relative to the corner's angular frequency."""
        k = np.arange(1, int(self.order) + 1)
        return np.asarray(np.exp(1j * np.pi * (2.0 * k + self.order - 1.0) / (2.0 * self.order)))

    def at(self, frequency_hz: Array) -> Complex:
        s = 1j * frequency_hz / self.corner_hz
        return np.asarray(1.0 / np.prod(1.0 - s[:, None] / self._poles, axis=1))

    @property
    def group_delay_s(self) -> float:
        return float(-(1.0 / self._poles).real.sum() / (2.0 * np.pi * self.corner_hz))

    @property
    def u_scale(self) -> float:
        return self.u_corner_pct / 100.0


@dataclass(frozen=True)
class Sinc(Filter):
    """`order` moving means of `points` samples at `rate_hz`, one after the other: a mean, or a sinc3, sinc5 decimator.

    `rate_hz` is the rate before the decimation, which itself changes nothing below half the rate after it.
    """

    points: float
    rate_hz: float
    order: float = 1.0
    u_rate_pct: float = 1.0

    def __post_init__(self) -> None:
        _within(1.0, MOST_POINTS, points=self.points)
        _whole(points=self.points)
        _positive(rate_hz=self.rate_hz)
        _order(self.order)
        _percent(u_rate_pct=self.u_rate_pct)

    def at(self, frequency_hz: Array) -> Complex:
        phase = np.pi * frequency_hz / self.rate_hz
        once, sine = np.ones_like(phase), np.sin(phase)
        np.divide(np.sin(self.points * phase), self.points * sine, out=once, where=sine != 0.0)
        return np.asarray((once * np.exp(-1j * (self.points - 1.0) * phase)) ** int(self.order))

    @property
    def group_delay_s(self) -> float:
        return self.order * (self.points - 1.0) / (2.0 * self.rate_hz)

    @property
    def u_scale(self) -> float:
        return self.u_rate_pct / 100.0


@dataclass(frozen=True)
class Fir(Filter):
    """A filter by its `taps` at `rate_hz`, the rate before a decimation. `ripple_pct`: how far it may differ from them.

    The taps count relative to their sum.
    """

    taps: tuple[float, ...]
    rate_hz: float
    ripple_pct: float = 0.0
    u_rate_pct: float = 1.0

    def __post_init__(self) -> None:
        if abs(sum(self.taps)) <= 1e-3 * sum(map(abs, self.taps)):
            raise ValueError("taps: their sum is 0, so that nothing passes at 0 Hz; give the taps of a low-pass filter")
        _positive(rate_hz=self.rate_hz)
        _percent(ripple_pct=self.ripple_pct, u_rate_pct=self.u_rate_pct)

    @property
    def _weights(self) -> Array:
        return np.array(self.taps) / sum(self.taps)

    def at(self, frequency_hz: Array) -> Complex:
        z = np.exp(-2j * np.pi * frequency_hz / self.rate_hz)
        return np.asarray(np.polynomial.polynomial.polyval(z, self._weights))

    @property
    def group_delay_s(self) -> float:
        return float(self._weights @ np.arange(len(self.taps))) / self.rate_hz

    @property
    def u_scale(self) -> float:
        return self.u_rate_pct / 100.0

    @property
    def u_size(self) -> float:
        return self.ripple_pct / 100.0


@dataclass(frozen=True)
class Table(Filter):
    """A calibration over frequency as laboratories print it: sensitivity relative to that of the certificate, phase
    (negative where the indication comes late), and the expanded uncertainty (k = 2) of the sensitivity.

    ln h is interpolated by cubics over ln f. Below the table |h| is that of its first row, and the phase is
    proportional to the frequency. Above it nothing is known: ln h goes on as it ends.
    """

    frequency_hz: tuple[float, ...]
    relative_sensitivity: tuple[float, ...]
    phase_deg: tuple[float, ...] = ()
    expanded_u_pct: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        rows = len(self.frequency_hz)
        if rows < FEWEST_ROWS:
            raise ValueError(f"frequency_hz: {rows} frequencies; give {FEWEST_ROWS} or more")
        for name in ("relative_sensitivity", "phase_deg", "expanded_u_pct"):
            values = getattr(self, name)
            if len(values) != rows and (values or name == "relative_sensitivity"):
                raise ValueError(f"{name}: {len(values)} values, but frequency_hz has {rows}; give one for each")
        if not self.frequency_hz[0] > 0.0 or (np.diff(self.frequency_hz) <= 0.0).any():
            raise ValueError("frequency_hz: must be above 0 and increase")
        _within(0.1, 10.0, relative_sensitivity=min(self.relative_sensitivity))
        _within(0.1, 10.0, relative_sensitivity=max(self.relative_sensitivity))
        for u in self.expanded_u_pct:
            _percent(expanded_u_pct=u)

    @property
    def _phase(self) -> Array:
        """(rows,) in rad, without jumps by a whole turn."""
        return np.unwrap(np.deg2rad(self.phase_deg or (0.0,) * len(self.frequency_hz)))

    @property
    def group_delay_s(self) -> float:
        frequency_hz = np.array(self.frequency_hz)
        return float(-(self._phase @ frequency_hz) / (frequency_hz @ frequency_hz) / (2.0 * np.pi))

    def at(self, frequency_hz: Array) -> Complex:
        rows_hz = np.array(self.frequency_hz)
        # Phase less that of the delay, which would be curved over ln f.
        left = self._phase + 2.0 * np.pi * rows_hz * self.group_delay_s
        held = np.clip(frequency_hz, rows_hz[0], BEYOND * rows_hz[-1])
        size = _cubic(np.log(held), np.log(rows_hz), np.log(self.relative_sensitivity), 0.0)
        phase = _cubic(np.log(held), np.log(rows_hz), left, left[0]) * np.minimum(frequency_hz / rows_hz[0], 1.0)
        return np.asarray(np.exp(size + 1j * (phase - 2.0 * np.pi * frequency_hz * self.group_delay_s)))

    @property
    def u_size(self) -> float:
        return max(self.expanded_u_pct, default=0.0) / 200.0

    @property
    def to_hz(self) -> float:
        return self.frequency_hz[-1]


KINDS: Mapping[str, type[Filter]] = {
    "flat": Flat, "delay": Delay, "highpass": Highpass, "lowpass": Lowpass, "mean": Sinc, "sinc": Sinc, "fir": Fir,
    "table": Table,
}  # fmt: skip


def filter_of(text: str) -> Filter:
    """The filter that a line of text states: its kind, then its numbers as name=value; lists with commas.

    Raises ValueError, which names what is wrong and what to give.
    """
    kind, *words = text.split() or [""]
    made = KINDS.get(kind)
    if made is None:
        raise ValueError(f"{kind!r} is no kind of filter; give one of {', '.join(KINDS)}")
    known = {f.name: f for f in fields(made)}
    values: dict[str, float | tuple[float, ...]] = {}
    hints = get_type_hints(made)
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or name not in known:
            raise ValueError(f"{word!r}: {kind} takes {_names(known)}")
        if name in values:
            raise ValueError(f"{name} is given twice; give it once")
        values[name] = _one_number(name, value) if hints[name] is float else _numbers(name, value)
    missing = [name for name, f in known.items() if f.default is MISSING and name not in values]
    if missing:
        raise ValueError(f"{kind} needs {_names(missing)}")
    return made(**values)


def _names(names: Iterable[str]) -> str:
    return ", ".join(f"{name}=..." for name in names)


def _one_number(name: str, value: str) -> float:
    numbers = _numbers(name, value)
    if len(numbers) != 1:
        raise ValueError(f"{name}: {len(numbers)} numbers; give one")
    return numbers[0]


def corner_apart(lines: Sequence[str]) -> tuple[tuple[str, ...], tuple[float, float]]:
    """The lines of text without that of a high-pass filter, and its corner and standard uncertainty in Hz; (0, 0) where
    there is none. Raises ValueError where a line states no filter, or two are high-pass filters."""
    filters = [filter_of(line) for line in lines]
    found = [one for one in filters if isinstance(one, Highpass)]
    if len(found) > 1:
        raise ValueError(f"there are {len(found)} high-pass filters; state one, with the corner of all together")
    corner = (found[0].corner_hz, found[0].corner_hz * found[0].u_corner_pct / 100.0) if found else (0.0, 0.0)
    return tuple(line for line, one in zip(lines, filters, strict=True) if one not in found), corner


def _numbers(name: str, value: str) -> tuple[float, ...]:
    parts = value.split(",")
    if len(parts) > MOST_NUMBERS:
        raise ValueError(f"{name}: {len(parts)} numbers; give {MOST_NUMBERS} at most")
    try:
        found = tuple(float(part) for part in parts)
    except ValueError:
        raise ValueError(f"{name}: {value[:40]!r} is no number; numbers of a list stand with commas between") from None
    if not all(map(math.isfinite, found)):
        raise ValueError(f"{name}: {value[:40]!r} is not finite")
    return found


def _within(low: float, high: float, **value: float) -> None:
    for name, number in value.items():
        if not low <= number <= high:
            ends = f"from {low:g} to {high:g}" if math.isfinite(high) else f"from {low:g} on"
            raise ValueError(f"{name}: {number:g}; give a number {ends}")


def _positive(**value: float) -> None:
    for name, number in value.items():
        if not number > 0.0:
            raise ValueError(f"{name}: {number:g}; give a number above 0")


def _percent(**value: float) -> None:
    _within(0.0, LARGEST_PCT, **value)


def _whole(**value: float) -> None:
    for name, number in value.items():
        if number != int(number):
            raise ValueError(f"{name}: {number:g}; give a whole number")


def _order(order: float) -> None:
    _within(1.0, HIGHEST_ORDER, order=order)
    _whole(order=order)


def _cubic(at: Array, x: Array, y: Array, first_slope: float) -> Array:
    """y (k,) at x (k,), interpolated by cubics with a continuous slope: Hermite's, with slopes by differences, the
    first one given. Beyond the last row it is a straight line."""
    slope = np.gradient(y, x, edge_order=2 if len(x) > 2 else 1)
    slope[0] = first_slope
    k = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    step, beyond = x[k + 1] - x[k], np.maximum(at - x[-1], 0.0)
    t = (at - beyond - x[k]) / step
    return np.asarray(
        slope[-1] * beyond
        + (1.0 + 2.0 * t) * (1.0 - t) ** 2 * y[k]
        + t * (1.0 - t) ** 2 * step * slope[k]
        + t**2 * (3.0 - 2.0 * t) * y[k + 1]
        + t**2 * (t - 1.0) * step * slope[k + 1]
    )
