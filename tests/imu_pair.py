"""Two IMUs on one board as a gateway reads them: blocks of 32 samples, the second one the first one's reference."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.config import parse_config
from agent.core.events import CalibrationUpdate, WindowReport
from benchmarks.online.runner import EPOCH_NS, Run, opened, tick, ticked
from hw.block import DeviceInfo, SampleBlock

Array = NDArray[np.float64]
BLOCK = 32


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """What the pipeline made of two IMUs: calibrations with the time of each in s, and windows."""

    calibrations: list[tuple[float, CalibrationUpdate]]
    windows: list[WindowReport]


def calibrated(
    time_s: Array, indications: Array, reference_mps2: Array, rotation: Array, sensitivity: float, rate_hz: float
) -> Session:
    """Indications (n, 3) beside a reference (n, 3), a = R a_ref; nobody tells positions."""
    infos = {
        "sensor": DeviceInfo("serial-csv", "virtual", "imu", "count", 3, rate_hz),
        "reference": DeviceInfo("serial-csv", "virtual", "imu 1", "m/s2", 3, rate_hz),
    }
    options = {name: {"port": name, "rate_hz": rate_hz, "axes": 3, "unit": info.unit} for name, info in infos.items()}
    channel = {
        "sensor": "sensor", "reference": "reference", "rotation": rotation.ravel().tolist(),
        "prior": {"sensitivity": sensitivity}, "temperature": {"offset_order": 0},
    }  # fmt: skip
    devices = [{"name": name, "driver": "serial-csv", "options": options[name]} for name in infos]
    run = Run(parse_config({"devices": devices, "channels": [channel], "zenoh": {"enabled": False}}, "two IMUs"))
    session = Session([], [])
    both = (_blocks("sensor", time_s, indications, rate_hz), _blocks("reference", time_s, reference_mps2, rate_hz))
    merged = heapq.merge(*both, key=lambda block: block.t_monotonic_ns)
    for event in [*opened(infos), *ticked(merged), tick(float(time_s[-1]) + 20.0)]:
        for result in run.feed(event):
            if isinstance(result, CalibrationUpdate):
                session.calibrations.append((run.now_s, result))
            elif isinstance(result, WindowReport):
                session.windows.append(result)
    run.close()
    return session


def _blocks(device: str, time_s: Array, values: Array, rate_hz: float) -> Iterator[SampleBlock]:
    for first in range(0, len(time_s) - BLOCK + 1, BLOCK):
        arrival_ns = np.round(time_s[first : first + BLOCK] * 1e9).astype(np.int64)
        yield SampleBlock(
            device, "boot", EPOCH_NS + int(arrival_ns[-1]), first, rate_hz, arrival_ns,
            np.arange(1, BLOCK + 1, dtype=np.int32), np.ascontiguousarray(values[first : first + BLOCK]),
        )  # fmt: skip
