"""The devices of a bench as devices of the driver `serial-csv`."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from hw.virtual.bench import Bench
from hw.virtual.serial_port import SampleLines
from hw.virtual.timebase import BenchTime

Role = Literal["sensor", "reference"]


def serial_lines(bench: Bench, role: Role, time: BenchTime) -> SampleLines:
    """The text that one device of the bench sends, for a `PtyDevice`."""
    if role == "sensor":
        values, due, resolution = bench.sensor_values, bench.sensor_samples_due, bench.parameters.sensor.resolution
    else:
        values, due = bench.reference_values, bench.reference_samples_due
        resolution = bench.parameters.reference.resolution
    return SampleLines(values, time.gated(due), decimals=decimals_of(resolution))


def serial_options(bench: Bench, role: Role) -> dict[str, Any]:
    """Options of `serial-csv` for one device of the bench, without the port."""
    p = bench.parameters
    if role == "sensor":
        return {"axes": 3, "rate_hz": p.sensor.clock.nominal_rate_hz, "sequence": True, "unit": p.sensor.unit}
    unit = "m/s" if p.reference.quantity == "velocity" else "m/s2"
    rate_hz = p.reference.clock.nominal_rate_hz
    return {"axes": p.reference.channels, "rate_hz": rate_hz, "sequence": True, "unit": unit}


def decimals_of(resolution: float) -> int:
    """Number of decimals that is enough to tell all multiples of `resolution` apart; 6 for an unquantised signal."""
    return max(0, -int(np.floor(np.log10(resolution) + 1e-9))) if resolution else 6
