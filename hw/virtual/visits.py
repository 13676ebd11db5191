"""A structure with several mounted sensors and one portable reference, which a person clamps beside one after another.

Each place of the structure moves in its own way. How the reference is clamped can be changed at any time: well, turned,
loosely, or beside a place that hardly moves.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hw.virtual.building_motion import BuildingMotion, BuildingSpectrum
from hw.virtual.noise import BLOCK, NoiseStream, generator
from hw.virtual.response import Response
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2, rotation
from hw.virtual.serial_port import PtyDevice, SampleLines
from hw.virtual.timebase import BenchTime, Clock

Array = NDArray[np.float64]
PERIOD_S = 600.0  # after which the motion repeats
RATE_HZ = 200.0
DECIMALS = 6
LOOSE_HZ, LOOSE_DAMPING = 25.0, 0.05  # a reference of 0.5 kg on a soft clamp
RATTLE = 0.1  # of the motion: the SD of the noise of a clamp that rattles
CALM = 0.01  # of the motion, when there is hardly any
LEAD_S = 0.3  # from the word of the person until the reference is clamped in the new way
REFERENCE = "reference"


@dataclass(frozen=True, slots=True, eq=False)
class Clamped:
    """How the reference is clamped: beside which sensor, turned by a rotation vector (3,) in deg, and loosely or not.

    `calm`: the structure hardly moves meanwhile.
    """

    sensor: int = 0
    turned_deg: Array = field(default_factory=lambda: np.zeros(3))
    loose: bool = False
    calm: bool = False


WELL = Clamped()


@dataclass(frozen=True, slots=True)
class StructureParameters:
    """What the structure is drawn from; standard deviations, all relative to the nominal sensitivity 1 per m/s2."""

    sensors: int = 3
    level_mps2: float = 0.3  # rms of the motion along each axis
    noise_mps2: float = 0.005
    reference_noise_mps2: float = 0.001
    u_main: float = 0.02
    u_transverse: float = 0.01
    u_offset_mps2: float = 0.05
    u_turned_deg: float = 0.0  # of every clamping, about each axis
    u_reference: float = 0.0  # of the reference's sensitivity
    band: BuildingSpectrum = field(default_factory=BuildingSpectrum)


class Structure:
    """The structure that `parameters` and `seed` determine. Only `clamp` changes it."""

    def __init__(self, parameters: StructureParameters, seed: int, way: Clamped = WELL) -> None:
        self.parameters, self.seed = parameters, seed
        random, p = generator(seed, NoiseStream.PRESET), parameters
        main, n = np.eye(3, dtype=bool), parameters.sensors
        self.sensitivity = np.eye(3) + np.where(main, p.u_main, p.u_transverse) * random.standard_normal((n, 3, 3))
        self.offset = p.u_offset_mps2 * random.standard_normal((n, 3))
        self.reference_sensitivity = 1.0 + p.u_reference * random.standard_normal()
        self._turns = random
        self.clocks = [Clock(RATE_HZ, rate_error=e, offset_s=1e-3) for e in random.uniform(-1e-4, 1e-4, n + 1)]
        self._moves: dict[tuple[int, bool], BuildingMotion] = {}
        self._since_s: list[float] = []
        self._ways: list[tuple[Clamped, Array]] = []
        self.clamp(way, 0.0)

    def clamp(self, way: Clamped, at_s: float) -> None:
        """The reference is clamped in this way from `at_s` on. Each clamping has a small rotation of its own."""
        by_deg = way.turned_deg + self.parameters.u_turned_deg * self._turns.standard_normal(3)
        for loose in {False, way.loose}:
            self._motion(way.sensor, loose)  # now, and not while a reader waits for samples
        self._ways.append((way, _turned(np.deg2rad(by_deg))))
        self._since_s.append(at_s)

    def values(self, device: int, first: int, n: int) -> Array:
        """Indications (n, 3) of a sensor, or of the reference as the last device, from sample `first` on."""
        p = self.parameters
        of_reference = device == p.sensors
        time_s = self.clocks[device].times(first, n)
        found = np.empty((n, 3))
        which = np.maximum(np.searchsorted(self._since_s, time_s, side="right") - 1, 0)
        for k in np.unique(which):
            way, turned = self._ways[k]
            there = which == k
            factor = CALM if way.calm else 1.0
            if not of_reference:
                found[there] = factor * self._motion(device, loose=False).at(time_s[there] % PERIOD_S)
                continue
            moved = factor * self._motion(way.sensor, way.loose).at(time_s[there] % PERIOD_S)
            felt = moved + np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2])
            if way.loose:
                felt += RATTLE * np.linalg.norm(moved, axis=1, keepdims=True) * self._white(device + 1, first, n)[there]
            found[there] = self.reference_sensitivity * felt @ turned
        if not of_reference:
            gravity = np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2])
            found = (found + gravity) @ self.sensitivity[device].T + self.offset[device]
        noise_mps2 = p.reference_noise_mps2 if of_reference else p.noise_mps2
        return found + noise_mps2 * self._white(device, first, n)

    def _motion(self, sensor: int, loose: bool) -> BuildingMotion:
        key = (sensor, loose)
        if key not in self._moves:
            random = generator(self.seed, NoiseStream.BUILDING_MOTION, sensor)
            response: Response | None = _on_a_spring if loose else None
            p = self.parameters
            self._moves[key] = BuildingMotion(
                random, p.band, (0.0, PERIOD_S), p.level_mps2, np.eye(3), response=response
            )
        return self._moves[key]

    def _white(self, device: int, first: int, n: int) -> Array:
        """White noise (n, 3) with SD 1, which does not depend on the order of the calls."""
        blocks = range(first // BLOCK, (first + n - 1) // BLOCK + 1)
        seed = self.seed + (device << 32)
        values = np.vstack([generator(seed, NoiseStream.SENSOR, block).standard_normal((BLOCK, 3)) for block in blocks])
        return values[first - blocks[0] * BLOCK :][:n]


class LiveStructure:
    """Context in which `serial-csv` finds the devices of a structure, under `options` by their names.

    Time 0 of the structure is the moment of entering.
    """

    def __init__(self, structure: Structure) -> None:
        self.structure = structure
        self.sensors = [f"sensor-{k + 1}" for k in range(structure.parameters.sensors)]
        self.options: dict[str, dict[str, Any]] = {}
        self._time = BenchTime()
        self._open = ExitStack()

    def __enter__(self) -> LiveStructure:
        for k, name in enumerate([*self.sensors, REFERENCE]):
            device = PtyDevice(SampleLines(self._values(k), self._time.gated(self._due(k)), decimals=DECIMALS))
            self._open.callback(device.stop)
            self.options[name] = {
                "port": str(device.path), "axes": 3, "rate_hz": RATE_HZ, "sequence": True, "unit": "m/s2",
            }  # fmt: skip
            device.start()
        self._time.begin(time.monotonic())
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def clamp(self, way: Clamped) -> None:
        """A person clamps the reference in this way; waits until it is so."""
        self.structure.clamp(way, self._time(time.monotonic()) + LEAD_S)
        time.sleep(LEAD_S)

    def _values(self, device: int) -> Any:
        return lambda first, n: self.structure.values(device, first, n)

    def _due(self, device: int) -> Any:
        clock = self.structure.clocks[device]
        return lambda t_s: int(clock.due(t_s))


def _on_a_spring(frequency_hz: Array) -> NDArray[np.complex128]:
    ratio = frequency_hz / LOOSE_HZ
    return np.asarray(1.0 / (1.0 - ratio**2 + 2j * LOOSE_DAMPING * ratio))


def _turned(vector_rad: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector."""
    angle = float(np.linalg.norm(vector_rad))
    return rotation(vector_rad / angle, angle) if angle else np.eye(3)
