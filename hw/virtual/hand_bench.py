"""A bench turned by hand in real time: sensor and reference, each on a pseudo-terminal of its own."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Any

from hw.virtual.bench import Bench
from hw.virtual.hand import ByHand
from hw.virtual.parameters import BenchParameters
from hw.virtual.schedule import Stand
from hw.virtual.serial_bench import Role, serial_lines, serial_options
from hw.virtual.serial_port import PtyDevice
from hw.virtual.timebase import BenchTime

LEAD_S = 0.3  # from the word to turn until the sensor moves: samples that are due by then are not asked for twice
SETTLED_S = 0.2  # after which no thread computes samples any more that it began before the word


class HandBench:
    """Context in which `serial-csv` finds the devices of a bench whose schedule is `ByHand`, under `options`.

    Time 0 of the bench is the moment of entering.
    """

    def __init__(self, parameters: BenchParameters, seed: int) -> None:
        assert isinstance(parameters.schedule, ByHand)
        self.bench = Bench(parameters, seed)
        self._schedule = parameters.schedule
        self._time = BenchTime()
        self._open = ExitStack()
        self.options: dict[Role, dict[str, Any]] = {}

    def __enter__(self) -> HandBench:
        for role in ("sensor", "reference"):
            device = PtyDevice(serial_lines(self.bench, role, self._time))
            self._open.callback(device.stop)
            self.options[role] = serial_options(self.bench, role) | {"port": str(device.path)}
            device.start()
        self._time.begin(time.monotonic())
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def turn(self, stand: Stand) -> float:
        """A person turns the sensor; gives the seconds until it stands in the new position."""
        stands_s = self._schedule.turn(stand, self._time(time.monotonic()) + LEAD_S)
        time.sleep(SETTLED_S)
        self.bench.forget()
        return max(stands_s - self._time(time.monotonic()), 0.0)
