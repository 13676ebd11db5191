"""Faults of the two devices in a building, after which their data tell nothing, or nothing true, about S and Q."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, SampleBlock

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Role = Literal["sensor", "reference", "check"]


class MotionOverTime(Protocol):
    """Acceleration as a function of time."""

    def at(self, time_s: Array) -> Array: ...


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """One device in one visit: its sample times (n,), the level of the building's motion (rms), its random generator.

    `first`: this is the first visit with the fault. `elsewhere`: motion that has nothing to do with the device.
    """

    role: Role
    time_s: Array
    level_mps2: float
    elsewhere: MotionOverTime
    random: np.random.Generator
    first: bool


@dataclass(frozen=True, slots=True, eq=False)
class Harm:
    """No fault. Each subclass overrides what its fault changes. `name` is for tables."""

    name: str = "none"

    @property
    def output(self) -> Array:
        """Matrix M (3, 3) of the sensor's output: while the fault lasts the true values are M S and M Q."""
        return np.eye(3)

    def size(self, frequency_hz: float) -> float:
        """The response of the sensor over that of the reference at a frequency, which multiplies S there."""
        del frequency_hz
        return 1.0

    def moved(self, visit: Visit, felt: Array) -> Array:
        """Acceleration (n, 3) at the device, from the acceleration `felt` (n, 3) without the fault."""
        del visit
        return felt

    def shown(self, visit: Visit, values: Array) -> Array:
        """Indications (n, 3), from the indications `values` (n, 3) without the fault."""
        del visit
        return values

    def arrived(self, visit: Visit, blocks: list[SampleBlock]) -> list[SampleBlock]:
        """Blocks as the gateway receives them."""
        del visit
        return blocks


HARMLESS = Harm()


@dataclass(frozen=True, slots=True, eq=False)
class Unplugged(Harm):
    """The cable of the reference is disconnected: no blocks, a constant value, or noise and 50 Hz hum."""

    how: Literal["lost", "constant", "hum"] = "lost"

    def shown(self, visit: Visit, values: Array) -> Array:
        if visit.role != "reference":
            return values
        still = np.full_like(values, 0.0123)
        if self.how == "hum":
            n = len(values)
            still += 0.02 * np.sin(2 * np.pi * 0.2503 * np.arange(n))[:, None]
            still += 0.01 * visit.random.standard_normal((n, 3))
        return still

    def arrived(self, visit: Visit, blocks: list[SampleBlock]) -> list[SampleBlock]:
        return [] if visit.role == "reference" and self.how == "lost" else blocks


@dataclass(frozen=True, slots=True, eq=False)
class DeadChannel(Harm):
    """One channel of a device has a constant value, or noise only."""

    role: Role = "sensor"
    axis: int = 1
    noise_mps2: float = 0.0

    @property
    def output(self) -> Array:
        alive = np.eye(3)
        if self.role == "sensor":
            alive[self.axis, self.axis] = 0.0
        return alive

    def shown(self, visit: Visit, values: Array) -> Array:
        if visit.role == self.role:
            values[:, self.axis] = 0.01 + self.noise_mps2 * visit.random.standard_normal(len(values))
        return values


@dataclass(frozen=True, slots=True, eq=False)
class Transformed(Harm):
    """The indications of a device are multiplied by a matrix (3, 3): wrong sensitivity, sign or order of the axes."""

    role: Role = "reference"
    matrix: Array = field(default_factory=lambda: np.eye(3))

    @property
    def output(self) -> Array:
        return self.matrix if self.role == "sensor" else np.eye(3)

    def shown(self, visit: Visit, values: Array) -> Array:
        return values @ self.matrix.T if visit.role == self.role else values


@dataclass(frozen=True, slots=True, eq=False)
class Filtered(Harm):
    """A device has another filter, or its mount a resonance: its response at frequencies (k,) in Hz, 1 at 0 Hz."""

    role: Role = "sensor"
    response: Callable[[Array], ComplexArray] = np.ones_like

    def size(self, frequency_hz: float) -> float:
        size = float(abs(self.response(np.array([frequency_hz]))[0]))
        return size if self.role == "sensor" else 1.0 / size

    def moved(self, visit: Visit, felt: Array) -> Array:
        if visit.role != self.role:
            return felt
        step_s = float(np.mean(np.diff(visit.time_s)))
        frequency_hz = np.fft.rfftfreq(len(felt), step_s).astype(np.float64)
        # The motion begins and ends with nothing, so that a visit may be taken for periodic.
        return np.fft.irfft(np.fft.rfft(felt, axis=0) * self.response(frequency_hz)[:, None], len(felt), axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class Rattling(Harm):
    """A loose part beside the sensor hits when the motion is strong, and rings in the sensor alone.

    It hits where the acceleration rises above `above` times the level of the motion, and rings with `amplitude` times
    this level at `frequency_hz`.
    """

    frequency_hz: float = 30.0
    amplitude: float = 0.5
    above: float = 1.5

    def moved(self, visit: Visit, felt: Array) -> Array:
        if visit.role != "sensor":
            return felt
        step_s = float(np.mean(np.diff(visit.time_s)))
        beyond = np.linalg.norm(felt, axis=1) > self.above * visit.level_mps2
        begins = beyond & ~np.concatenate([[False], beyond[:-1]])
        hits = begins * visit.random.normal(1.0, 0.3, len(felt)) * visit.random.choice([-1.0, 1.0], len(felt))
        cycles = np.arange(int(6.0 / self.frequency_hz / step_s)) * step_s * self.frequency_hz
        rings = np.convolve(hits, np.exp(-cycles / 1.5) * np.sin(2.0 * np.pi * cycles))[: len(felt)]
        return np.asarray(felt + self.amplitude * visit.level_mps2 * rings[:, None] * np.array([1.0, 0.4, -0.6]))


@dataclass(frozen=True, slots=True, eq=False)
class Slipping(Harm):
    """The sensor is held by friction alone: where the acceleration is above `above` times the level of the motion it
    slips, and feels no more than that."""

    above: float = 1.5

    def moved(self, visit: Visit, felt: Array) -> Array:
        if visit.role != "sensor":
            return felt
        size = np.maximum(np.linalg.norm(felt, axis=1, keepdims=True), np.finfo(float).tiny)
        return np.asarray(felt * np.minimum(1.0, self.above * visit.level_mps2 / size))


@dataclass(frozen=True, slots=True, eq=False)
class KnockedOff(Harm):
    """The sensor has fallen off its mount and is turned.

    It follows the building (`follows`), or it hangs by its cable.
    """

    turn: Array = field(default_factory=lambda: np.eye(3))
    follows: bool = True

    def moved(self, visit: Visit, felt: Array) -> Array:
        return felt if visit.role == "reference" or self.follows else visit.elsewhere.at(visit.time_s)

    def shown(self, visit: Visit, values: Array) -> Array:
        # S is near 1, so turning the indications is the same as turning the sensor, gravity included.
        return values @ self.turn.T if visit.role == "sensor" else values


@dataclass(frozen=True, slots=True, eq=False)
class FarAway(Harm):
    """The reference stands 100 m away and shares only the fraction `common` of its amplitude with the sensor."""

    common: float = 0.3

    def moved(self, visit: Visit, felt: Array) -> Array:
        if visit.role == "sensor":
            return felt
        return np.asarray(self.common * felt + np.sqrt(1 - self.common**2) * visit.elsewhere.at(visit.time_s))


@dataclass(frozen=True, slots=True, eq=False)
class Clipped(Harm):
    """The sensor limits its indications to `peak` times the rms of the motion, about their mean."""

    peak: float = 1.0

    def shown(self, visit: Visit, values: Array) -> Array:
        if visit.role == "reference":
            return values
        mean = values.mean(axis=0)
        return np.asarray(np.clip(values, mean - self.peak * visit.level_mps2, mean + self.peak * visit.level_mps2))


@dataclass(frozen=True, slots=True, eq=False)
class Lossy(Harm):
    """A fraction `share` of the samples is lost, `run` in a row.

    `told`: the sample numbers show the loss; otherwise the device numbers only the samples that are left.
    """

    role: Role = "sensor"
    share: float = 0.1
    run: int = 16
    told: bool = True

    def arrived(self, visit: Visit, blocks: list[SampleBlock]) -> list[SampleBlock]:
        if visit.role != self.role:
            return blocks
        left: list[SampleBlock] = []
        number = round(blocks[0].first_index * (1 - self.share))
        for block in blocks:
            kept = np.repeat(visit.random.random(-(-block.n // self.run)) >= self.share, self.run)[: block.n]
            if self.told:
                left += _pieces(block, kept)
            elif kept.any():
                left.append(_shortened(block, kept, number))
                number += int(kept.sum())
        return left


@dataclass(frozen=True, slots=True, eq=False)
class ClockStep(Harm):
    """From one moment on, all data of a device arrive later, or its sample numbers jump, or the gateway's UTC jumps."""

    role: Role = "sensor"
    what: Literal["arrival", "number", "utc"] = "arrival"
    step: float = 0.1  # s of the clock that jumps

    def arrived(self, visit: Visit, blocks: list[SampleBlock]) -> list[SampleBlock]:
        since = len(blocks) // 2 if visit.first else 0
        if self.what != "utc" and visit.role != self.role:
            return blocks
        return blocks[:since] + [self._stepped(block) for block in blocks[since:]]

    def _stepped(self, block: SampleBlock) -> SampleBlock:
        step_ns = round(self.step * 1e9)
        if self.what == "number":
            return replace(block, first_index=block.first_index + round(self.step * block.nominal_rate_hz))
        if self.what == "utc":
            return replace(block, t_utc_ns=block.t_utc_ns + step_ns)
        late = block.burst_t_monotonic_ns + step_ns
        return replace(block, burst_t_monotonic_ns=late, t_utc_ns=block.t_utc_ns + step_ns)


def _pieces(block: SampleBlock, kept: NDArray[np.bool_]) -> list[SampleBlock]:
    """The samples `kept` of a block, as one block per stretch without a gap; arrivals as before."""
    edges = np.flatnonzero(np.diff(kept.astype(np.int8), prepend=0, append=0)).tolist()
    pieces = []
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        begun, done = np.searchsorted(block.burst_count, [first + 1, stop])
        burst = np.arange(begun, done + 1)
        piece = replace(
            block,
            first_index=block.first_index + first,
            burst_t_monotonic_ns=block.burst_t_monotonic_ns[burst],
            burst_count=(np.minimum(block.burst_count[burst], stop) - first).astype(np.int32),
            indications=block.indications[first:stop].copy(),
            flags=block.flags | BlockFlags.GAP,
            t_utc_ns=block.t_utc_ns - block.t_monotonic_ns + int(block.burst_t_monotonic_ns[burst[-1]]),
        )
        pieces.append(piece)
    return pieces


def _shortened(block: SampleBlock, kept: NDArray[np.bool_], number: int) -> SampleBlock:
    """A block with only the samples `kept`, the first one with `number`; bursts without these samples are removed."""
    count = np.cumsum(kept)[block.burst_count - 1]
    some = np.diff(count, prepend=0) > 0
    return replace(
        block,
        first_index=number,
        burst_t_monotonic_ns=block.burst_t_monotonic_ns[some],
        burst_count=count[some].astype(np.int32),
        indications=np.array(block.indications, dtype=np.float64)[kept],
        t_utc_ns=block.t_utc_ns - block.t_monotonic_ns + int(block.burst_t_monotonic_ns[some][-1]),
    )
