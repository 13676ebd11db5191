"""The kinds of harm, each drawn at random with its size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from hw.virtual.harm import (
    Array,
    Clipped,
    ClockStep,
    ComplexArray,
    DeadChannel,
    FarAway,
    Filtered,
    Harm,
    KnockedOff,
    Lossy,
    Rattling,
    Role,
    Slipping,
    Transformed,
    Unplugged,
)
from hw.virtual.schedule import rotation

Drawing = Callable[[np.random.Generator], Harm]


def _role(random: np.random.Generator) -> Role:
    return "sensor" if random.random() < 0.5 else "reference"


def _wrong_sensitivity(random: np.random.Generator) -> Harm:
    role: Role = _role(random)
    factor = (1.6, 1 / 1.6, -1.0)[int(random.integers(3))]
    axes = np.eye(3)
    if random.random() < 0.5:
        return Transformed(f"wrong sensitivity, {role}", role, factor * axes)
    axis = int(random.integers(3))
    axes[axis, axis] = factor
    return Transformed(f"wrong sensitivity, one axis, {role}", role, axes)


def _swapped(random: np.random.Generator) -> Harm:
    role: Role = _role(random)
    order: Sequence[int] = ((1, 0, 2), (0, 2, 1), (2, 1, 0), (1, 2, 0), (2, 0, 1))[int(random.integers(5))]
    return Transformed(f"swapped axes, {role}", role, np.eye(3)[list(order)])


def _knocked_off(random: np.random.Generator) -> Harm:
    axis = random.standard_normal(3)
    turn = rotation(axis / np.linalg.norm(axis), np.deg2rad(random.uniform(8.0, 180.0)))
    follows = bool(random.random() < 0.7)
    return KnockedOff(f"knocked off, {'follows' if follows else 'hangs'}", turn, follows)


def _lossy(random: np.random.Generator) -> Harm:
    role, told = _role(random), bool(random.random() < 0.5)
    return Lossy(f"10 % lost, {'told' if told else 'untold'}", role, 0.1, (1, 16)[int(random.integers(2))], told)


def _clock_step(random: np.random.Generator) -> Harm:
    what: Literal["arrival", "number", "utc"] = ("arrival", "number", "utc")[int(random.integers(3))]
    step = float(np.exp(random.uniform(np.log(0.03), np.log(3.0))))
    if what == "utc":
        step *= 3600.0 * random.choice([-1.0, 1.0])
    return ClockStep(f"clock step, {what}", _role(random), what, step)


def _dead(random: np.random.Generator, role: Role) -> Harm:
    noise = 0.005 * float(random.integers(2))
    return DeadChannel(f"dead channel, {role}", role, int(random.integers(3)), noise)


def _unplugged(random: np.random.Generator) -> Harm:
    how: Literal["lost", "constant", "hum"] = ("lost", "constant", "hum")[int(random.integers(3))]
    return Unplugged(f"unplugged, {how}", how)


def _filtered(random: np.random.Generator) -> Harm:
    role, corner_hz = _role(random), float(random.uniform(10.0, 60.0))

    def response(frequency_hz: Array) -> ComplexArray:
        return np.asarray(1.0 / (1.0 + 1j * frequency_hz / corner_hz), dtype=np.complex128)

    return Filtered(f"low-pass, {role}", role, response)


def _resonant(random: np.random.Generator) -> Harm:
    role, natural_hz, quality = _role(random), float(random.uniform(6.0, 40.0)), float(random.uniform(3.0, 50.0))

    def response(frequency_hz: Array) -> ComplexArray:
        ratio = frequency_hz / natural_hz
        return np.asarray(1.0 / (1.0 - ratio**2 + 1j * ratio / quality), dtype=np.complex128)

    return Filtered(f"resonance, {role}", role, response)


def _rattling(random: np.random.Generator) -> Harm:
    frequency_hz, amplitude = float(random.uniform(5.0, 40.0)), float(random.uniform(0.1, 2.0))
    return Rattling("rattles", frequency_hz, amplitude, float(random.uniform(0.8, 2.0)))


KINDS: dict[str, Drawing] = {
    "reference unplugged": _unplugged,
    "dead channel of the sensor": lambda random: _dead(random, "sensor"),
    "dead channel of the reference": lambda random: _dead(random, "reference"),
    "wrong sensitivity": _wrong_sensitivity,
    "swapped axes": _swapped,
    "knocked off its mount": _knocked_off,
    "100 m away": lambda random: FarAway("100 m away", float(random.uniform(0.0, 0.65))),
    "clipping": lambda random: Clipped("clipping", float(random.uniform(0.4, 1.6))),
    "10 % lost": _lossy,
    "clock step": _clock_step,
    "low-pass filter": _filtered,
    "mount resonates": _resonant,
    "rattles": _rattling,
    "slips on its mount": lambda random: Slipping("slips", float(random.uniform(0.5, 2.0))),
}
