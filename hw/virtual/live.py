"""A bench preset in real time: an ADXL355 under the real smbus2, and a reference on a pseudo-terminal."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np

from hw.adxl355_registers import ADXL355, STATED_HZ_A_KHZ
from hw.virtual.adxl355_twin import Adxl355Twin, filters
from hw.virtual.bench import Bench
from hw.virtual.kernel import BCM2835, I2CBus, installed
from hw.virtual.parameters import BenchParameters
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2
from hw.virtual.serial_bench import serial_lines, serial_options
from hw.virtual.serial_port import PtyDevice
from hw.virtual.timebase import BenchTime

ADDRESS = 0x1D


class LiveBench:
    """Context in which `adxl355` and `serial-csv` find the bench's devices, with the options given here.

    Time 0 of the bench is the moment when the sensor starts to measure. Poses in seconds since the sensor's first
    sample are therefore poses of the bench's clock. `bus` and `port` accept faults (unplug). Raises ValueError if the
    sensor of the bench does not have the counts of an ADXL355.
    """

    def __init__(
        self, parameters: BenchParameters, seed: int, *, bus: int = 1, clock: Callable[[], float] = time.monotonic
    ) -> None:
        rate_hz = parameters.sensor.clock.nominal_rate_hz
        chip = replace(parameters.sensor, response=filters(rate_hz))
        self.bench = Bench(replace(parameters, sensor=chip), seed)
        self.time = BenchTime()
        twin = Adxl355Twin(
            self.bench.sensor_counts,
            self._sensor_samples_due,
            clock,
            temperature_raw=self._temperature_raw,
        )
        self.bus = I2CBus({ADDRESS: twin}, adapter=BCM2835)
        self.sensor_options: dict[str, Any] = {
            "bus": bus,
            "address": ADDRESS,
            "rate_hz": rate_hz,
            "bus_khz": max(400.0, rate_hz / STATED_HZ_A_KHZ),
            "range_g": _range_g(parameters.sensor.nominal_sensitivity),
        }
        self._lines = serial_lines(self.bench, "reference", self.time)
        self._clock = clock
        self._open = ExitStack()

    def __enter__(self) -> LiveBench:
        # The first values take 20 ms to load, but the FIFO holds only 32 samples: load them before the first read.
        self.bench.sensor_counts(0, 1)
        self.bench.reference_values(0, 1)
        self.port = PtyDevice(self._lines, self._clock)
        self._open.callback(self.port.stop)
        self._open.enter_context(installed({f"/dev/i2c-{self.sensor_options['bus']}": self.bus}))
        self.port.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    @property
    def reference_options(self) -> dict[str, Any]:
        """Options of `serial-csv` for the reference."""
        return serial_options(self.bench, "reference") | {"port": str(self.port.path)}

    def _sensor_samples_due(self, t_s: float) -> int:
        # The twin first asks for samples when it is set to measure: that moment is time 0 of the bench.
        if not self.time.begun:
            self.time.begin(t_s)
        return self.bench.sensor_samples_due(self.time(t_s))

    def _temperature_raw(self, t_s: float) -> int:
        degc = float(self.bench.parameters.temperature.at(np.array(self.time(t_s))))
        return round(1885 - 9.05 * (degc - 25))  # ADXL355 data sheet


def _range_g(nominal_sensitivity: float) -> int:
    for range_g, counts in ADXL355.counts_per_g.items():
        if abs(nominal_sensitivity * STANDARD_GRAVITY_MPS2 - counts) < 1e-6 * counts:
            return range_g
    raise ValueError(f"the ADXL355 has no range with {nominal_sensitivity:g} counts per m/s2")
