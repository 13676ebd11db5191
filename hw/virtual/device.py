"""Driver `virtual`: the sensor or the reference of the virtual bench, without a port; at real time or faster."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator

from hw.block import DeviceInfo
from hw.buffered_sensor import BUFFER_S, BufferedSensor, Indications
from hw.data_time import DataClock, together
from hw.sensor import Clock, DeviceLost, Options, system_clock
from hw.virtual.bench import Bench
from hw.virtual.parameters import BenchParameters, ReferenceParameters
from hw.virtual.presets import PRESETS
from hw.virtual.timebase import BenchTime

ReferenceKind = Literal["preset", "vibrometer", "tri-axial"]
# A quarter turn about z: a = R a_ref.
ROTATION = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
VIBROMETER_NOISE_MPS, VIBROMETER_RESOLUTION_MPS = 10e-6, 1e-6  # of a common vibrometer at 1 kHz and 1 m/s full scale


class VirtualOptions(Options):
    """Options of `virtual`. Sensor and reference belong to one bench if preset, seed and speed are the same."""

    role: Literal["sensor", "reference"] = Field(description="which device of the bench")
    preset: str = Field("plain", description=f"which bench: {', '.join(PRESETS)}")
    seed: int = Field(1, ge=0, lt=2**32, description="seed of the bench's parameters and noise")
    speed: float = Field(
        1.0, gt=0, le=100, description="factor by which time runs faster than real time, stamps included"
    )
    reference: ReferenceKind = Field(
        "preset",
        description="preset: as in the preset; vibrometer: velocity; tri-axial: its x along the sensor's y",
    )

    @field_validator("preset")
    @classmethod
    def _check_preset(cls, value: str) -> str:
        if value not in PRESETS:
            raise ValueError(f"no preset {value!r}; available: {', '.join(PRESETS)}")
        return value

    @property
    def axis_count(self) -> int:
        """Three of the sensor; of a reference as its bench has it."""
        return 3 if self.role == "sensor" else parameters_of(self).reference.channels


class BenchClock:
    """Time of one bench: the clock of its data, and the time since its first device was opened."""

    def __init__(self, clock: Clock, speed: float) -> None:
        self.data = DataClock(clock, speed)
        self._time = BenchTime()

    def begin(self) -> None:
        """Start the motion of the bench; no effect if it has started."""
        if not self._time.begun:
            self._time.begin(self._now_s())

    @property
    def passed_s(self) -> float:
        """Time since `begin`, s."""
        return self._time(self._now_s())

    def _now_s(self) -> float:
        return self.data()[0] * 1e-9


class Virtual(BufferedSensor):
    """Keeps one second of samples for its reader, like the buffer of a library.

    `plugged = False` simulates a lost device.
    """

    options_model: ClassVar[type[Options]] = VirtualOptions

    def __init__(
        self,
        name: str,
        options: VirtualOptions,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        key = (clock, options.preset, options.seed, options.speed)
        self._bench_clock = together(key, lambda: BenchClock(clock, options.speed))
        data = self._bench_clock.data
        super().__init__(name, options, clock=data, sleep=data.slowed(sleep))
        self._bench = Bench(parameters_of(options), options.seed)
        self.plugged = True
        self._next = 0

    def _where(self) -> str:
        options = self._options
        return f"virtual bench {options.preset}/{options.seed}, {options.role}"

    def _start(self) -> DeviceInfo:
        if not self.plugged:
            raise DeviceLost(f"{self._where()}: unplugged")
        self._values(0, 1)  # the first values take some ms to load
        self._bench_clock.begin()
        self._next = self._due()
        return self._sensor_info() if self._options.role == "sensor" else self._reference_info()

    def _sensor_info(self) -> DeviceInfo:
        sensor = self._bench.parameters.sensor
        limited = np.isfinite(sensor.limit)
        return DeviceInfo(
            driver="virtual",
            kind="virtual sensor",
            serial_number=f"{self._options.preset}-{self._options.seed}",
            unit=sensor.unit,
            axes=3,
            nominal_rate_hz=sensor.clock.nominal_rate_hz,
            range_mps2=sensor.limit / sensor.nominal_sensitivity if limited else None,
            nominal_sensitivity=sensor.nominal_sensitivity,
            own_clock=self._options.speed != 1.0,
        )

    def _reference_info(self) -> DeviceInfo:
        reference = self._bench.parameters.reference
        return DeviceInfo(
            driver="virtual",
            kind=f"virtual reference, {reference.quantity}",
            serial_number=f"{self._options.preset}-{self._options.seed}",
            unit="m/s" if reference.quantity == "velocity" else "m/s2",
            axes=reference.channels,
            nominal_rate_hz=reference.clock.nominal_rate_hz,
            own_clock=self._options.speed != 1.0,
        )

    def _ends(self, info: DeviceInfo) -> tuple[float, float]:  # noqa: ARG002 - the bench has the range
        limit = self._bench.parameters.sensor.limit if self._options.role == "sensor" else np.inf
        return -limit, limit

    def _stop(self) -> None:
        """There is nothing to release."""

    def _take(self) -> tuple[Indications, bool]:
        if not self.plugged:
            raise DeviceLost(f"{self._where()}: unplugged")
        due = self._due()
        first, self._next = self._next, due
        kept = min(due - first, round(BUFFER_S * self._cutter.nominal_rate_hz))
        return self._values(first, kept), first + kept < due

    def _due(self) -> int:
        """Number of samples that exist now."""
        passed_s = self._bench_clock.passed_s
        if self._options.role == "sensor":
            return self._bench.sensor_samples_due(passed_s)
        return self._bench.reference_samples_due(passed_s)

    def _values(self, first: int, n: int) -> Indications:
        if self._options.role == "reference":
            return self._bench.reference_values(first, n)
        counted = self._bench.parameters.sensor.unit == "count"
        return self._bench.sensor_counts(first, n) if counted else self._bench.sensor_values(first, n)

    def _temperature(self) -> tuple[None, float | None]:
        if self._options.role == "reference":
            return None, None
        return None, float(self._bench.parameters.temperature.at(np.array(self._bench_clock.passed_s)))


def parameters_of(options: VirtualOptions) -> BenchParameters:
    """The bench of the preset with the chosen reference."""
    parameters = PRESETS[options.preset](options.seed)
    return replace(parameters, reference=_reference(parameters.reference, options.reference))


def _reference(preset: ReferenceParameters, kind: ReferenceKind) -> ReferenceParameters:
    if kind == "vibrometer":
        return replace(preset, quantity="velocity", noise=VIBROMETER_NOISE_MPS, resolution=VIBROMETER_RESOLUTION_MPS)
    return replace(preset, rotation=ROTATION) if kind == "tri-axial" else preset
