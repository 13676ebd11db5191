"""Driver `serial-csv-fast`: `serial-csv` with a clock that runs FIELDCAL_SOAK_SPEED times as fast, for the soak."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from hw.sensor import Clock, system_clock
from hw.serial_stream import SerialCsv

SPEED = int(os.environ.get("FIELDCAL_SOAK_SPEED", "1"))
_ORIGIN = system_clock()  # the driver is imported before the run's origin: its stamps are never before that


class FastSerialCsv(SerialCsv):
    """A block holds half a second of the fast clock, and pauses are as much shorter."""

    def __init__(
        self,
        name: str,
        options: Any,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(name, options, clock=lambda: _scaled(clock()), sleep=lambda pause_s: sleep(pause_s / SPEED))


def _scaled(now: tuple[int, int]) -> tuple[int, int]:
    monotonic_ns, utc_ns = (first + SPEED * (t - first) for first, t in zip(_ORIGIN, now, strict=True))
    return monotonic_ns, utc_ns
