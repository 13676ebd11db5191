"""Driver `serial-csv-fast`: `serial-csv` with a clock that runs FIELDCAL_FAST times as fast as the machine's clock.

With a device that sends faster by the same factor, hours of stamps, windows and file rotations take minutes. The agent
finds the driver through its entry point, like every third-party driver.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from hw.block import DeviceInfo
from hw.sensor import Clock, system_clock
from hw.serial_stream import SerialCsv

SPEED = int(os.environ.get("FIELDCAL_FAST", "1"))
# The driver is imported before the run's origin is set, so its stamps are never earlier than the origin
_ORIGIN_NS, _ = system_clock()


class FastSerialCsv(SerialCsv):
    """A block holds half a second of the fast clock; the pauses are shorter by the same factor."""

    def __init__(
        self,
        name: str,
        options: Any,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(name, options, clock=lambda: _ahead(clock()), sleep=lambda pause_s: sleep(pause_s / SPEED))

    def open(self) -> DeviceInfo:
        """The stamps are of the fast clock."""
        return replace(super().open(), own_clock=SPEED != 1)


def _ahead(now: tuple[int, int]) -> tuple[int, int]:
    """Times of the fast clock. UTC is ahead by as much as the monotonic clock, so a step of UTC keeps its size."""
    ahead_ns = (SPEED - 1) * (now[0] - _ORIGIN_NS)
    return now[0] + ahead_ns, now[1] + ahead_ns


def environment(speed: int, site: Path) -> dict[str, str]:
    """Environment variables with which a process finds the driver; its entry point is written into `site`."""
    plug_in = site / "fieldcal_fast-0.dist-info"
    plug_in.mkdir(parents=True, exist_ok=True)
    (plug_in / "METADATA").write_text("Metadata-Version: 2.1\nName: fieldcal-fast\nVersion: 0\n")
    (plug_in / "entry_points.txt").write_text(
        "[fieldcal.sensors]\nserial-csv-fast = benchmarks.fast_serial:FastSerialCsv\n"
    )
    root = Path(__file__).resolve().parents[1]
    return {"PYTHONPATH": os.pathsep.join([str(root), str(site)]), "FIELDCAL_FAST": str(speed)}
