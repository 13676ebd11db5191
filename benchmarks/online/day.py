"""A day of 1 kHz from the paper's bench: the CPU time of the pipeline alone.

The sensor stands for 57 s in each of four positions, then it is turned: one window per minute, all day. `CYCLES` cycles
are generated once and then played repeatedly with increasing sample numbers and arrival times, so that the pipeline
receives a normal day of data.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from agent.config import Config, parse_config
from agent.core.events import CalibrationUpdate, Event, WindowReport
from benchmarks.online.runner import Run, opened, tick
from hw.block import DeviceInfo, SampleBlock
from hw.virtual.bench import Bench
from hw.virtual.presets import plain
from hw.virtual.timebase import Clock

RATE_HZ = 1000.0
HOLD_S, TURN_S = 57.0, 3.0
BLOCK_S = 5.0
BURST = 25
CYCLES = 2  # of the schedule, which takes four minutes
DAY_S = 86_400.0


def config(bench: Bench) -> Config:
    """The bench's four positions, repeated."""
    poses = [
        {"start_s": p.start_s, "stop_s": p.stop_s, "theta_deg": p.theta_deg, "alpha_deg": p.alpha_deg}
        for p in bench.poses
    ]
    options = {"port": "p", "rate_hz": RATE_HZ}
    raw = {
        "devices": [
            {"name": name, "driver": "serial-csv", "options": options | {"axes": axes, "unit": unit}}
            for name, axes, unit in (("sensor", 3, "count"), ("reference", 1, "m/s2"))
        ],
        "channels": [
            {
                "sensor": "sensor",
                "reference": "reference",
                "prior": {"sensitivity": bench.parameters.sensor.nominal_sensitivity},
                "certificate": {"stability_pct": 0.0},  # the virtual reference does not drift
                "poses": poses,
                "poses_repeat_s": bench.parameters.schedule.period_s,
            }
        ],
        "zenoh": {"enabled": False},
    }
    return parse_config(raw, "day")


def bench() -> Bench:
    """The preset `plain` with exact clocks, so that the generated data can be repeated."""
    p = plain(1)
    exact = Clock(RATE_HZ)
    stands = tuple(replace(stand, hold_s=HOLD_S) for stand in p.schedule.stands)
    return Bench(
        replace(
            p,
            schedule=replace(p.schedule, stands=stands, turn_s=TURN_S),
            sensor=replace(p.sensor, clock=exact),
            reference=replace(p.reference, clock=exact),
        ),
        1,
    )


def events(bench: Bench, duration_s: float, block_s: float = BLOCK_S) -> Iterator[Event]:
    """Openings, then blocks of `block_s` for `duration_s`, each followed by a tick."""
    n = round(block_s * RATE_HZ)
    blocks = round(CYCLES * bench.parameters.schedule.period_s / block_s)
    held = [(bench.sensor_counts(k * n, n), bench.reference_values(k * n, n)) for k in range(blocks)]
    count = np.arange(BURST, n + 1, BURST, dtype=np.int32)
    late_ns = np.random.default_rng(1).exponential(2e5, len(count)).astype(np.int64)
    yield from opened(
        {
            "sensor": DeviceInfo("serial-csv", "virtual", "1", "count", 3, RATE_HZ),
            "reference": DeviceInfo("serial-csv", "virtual", "2", "m/s2", 1, RATE_HZ),
        }
    )
    for k in range(int(duration_s / block_s)):
        arrivals_ns = ((k * n + count) * (1e9 / RATE_HZ)).astype(np.int64) + late_ns
        counts, reference = held[k % blocks]
        common = ("boot", int(arrivals_ns[-1]), k * n, RATE_HZ, arrivals_ns, count)
        yield SampleBlock("sensor", *common, counts)
        yield SampleBlock("reference", *common, reference)
        yield tick((k + 1) * block_s)


def measure(duration_s: float) -> tuple[float, int, int]:
    """CPU time in s, number of used windows and number of calibrations of a run."""
    world = bench()
    run = Run(config(world))
    feed = events(world, duration_s)
    first = next(feed)  # the data are generated before the first event
    begin = time.process_time()
    windows = updates = 0
    for event in itertools.chain([first], feed):
        for result in run.feed(event):
            windows += isinstance(result, WindowReport) and result.used
            updates += isinstance(result, CalibrationUpdate)
    return time.process_time() - begin, windows, updates


def table() -> str:
    """The result as text."""
    cpu_s, windows, updates = measure(DAY_S)
    blocks = 2 * int(DAY_S / BLOCK_S)
    return (
        f"The pipeline needs **{cpu_s:.0f} s** of one core for a day of the bench: sensor 1 kHz x 3 and reference "
        f"1 kHz, {blocks} blocks, {windows} windows used, {updates} calibrations. {CYCLES} cycles of four minutes are "
        "simulated and repeated; the time for the simulation is not in the figure."
    )
