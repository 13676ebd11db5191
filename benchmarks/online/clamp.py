"""A bench as events: blocks of hw.virtual.bench as a gateway would receive them, with the arrival of each burst."""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from agent.core.events import Event
from benchmarks.online.runner import EPOCH_NS, opened, tick, ticked
from hw.block import DeviceInfo, SampleBlock
from hw.virtual.bench import Bench, BenchRecording

BLOCK_S = 5.0
Array = NDArray[np.float64]


def bench_events(bench: Bench, recording: BenchRecording) -> Iterator[Event]:
    """Openings and blocks of a recording of this bench, in order of arrival; devices "sensor" and "reference"."""
    p = bench.parameters
    sensor_hz, reference_hz = p.sensor.clock.nominal_rate_hz, p.reference.clock.nominal_rate_hz
    unit = "m/s2" if p.reference.quantity == "acceleration" else "m/s"
    yield from opened(
        {
            "sensor": DeviceInfo("serial-csv", "virtual", "bench-sensor", p.sensor.unit, 3, sensor_hz),
            "reference": DeviceInfo(
                "serial-csv", "virtual", "bench-reference", unit, p.reference.channels, reference_hz
            ),
        }
    )
    sensor = blocks("sensor", recording.sensor_stamp_s, recording.v, sensor_hz, recording.temperature_degc)
    reference = blocks("reference", recording.reference_stamp_s, recording.reference, reference_hz)
    yield from ticked(heapq.merge(sensor, reference, key=lambda block: block.t_monotonic_ns))
    yield tick(float(recording.sensor_stamp_s[-1]) + 10.0)


def blocks(
    device: str, stamp_s: Array, values: Array, rate_hz: float, temperature_degc: Array | None = None
) -> Iterator[SampleBlock]:
    """Blocks of about `BLOCK_S` from stamps (n,), which are equal within a burst, and values (n, m)."""
    last = np.append(np.flatnonzero(np.diff(stamp_s) > 0), len(stamp_s) - 1)  # the newest sample of each burst
    arrivals_ns = np.round(stamp_s[last] * 1e9).astype(np.int64)
    edges = np.flatnonzero(np.diff(stamp_s[last] // BLOCK_S, append=np.inf)) + 1
    first = begin = 0
    for end in edges.tolist():
        stop = int(last[end - 1]) + 1
        degc = None if temperature_degc is None else float(temperature_degc[stop - 1])
        yield SampleBlock(
            device, "boot", EPOCH_NS + int(arrivals_ns[end - 1]), first, rate_hz, arrivals_ns[begin:end],
            (last[begin:end] + 1 - first).astype(np.int32), np.ascontiguousarray(values[first:stop]),
            temperature_degc=degc,
        )  # fmt: skip
        first, begin = stop, end
