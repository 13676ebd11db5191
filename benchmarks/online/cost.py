"""Cost of a window in a long run: CPU time of the pipeline and size of its state, from window 10 to 10,000."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agent.core.events import WindowReport
from benchmarks.online.node import Timing, node
from benchmarks.online.runner import Run, visits

TIMING = Timing(10.0, 3600.0, 10_000)
AT = (10, 100, 1000, 10_000)
NEAR = 200  # largest number of windows around each stated window; their median is reported


@dataclass(frozen=True, slots=True)
class Cost:
    """Cost around one window: median CPU time of all events of a window (ms), size of the snapshot, process memory."""

    window: int
    cpu_ms: float
    snapshot_bytes: int
    resident_mb: float


def measure(windows: int = TIMING.windows) -> list[Cost]:
    """Simulate one run of `windows` windows, an hour apart, at 100 Hz."""
    drawn = node(1, all_axes=True, timing=TIMING)
    run = Run(drawn.config)
    spent: list[float] = []
    costs: list[Cost] = []
    counted, cpu_s = 0, 0.0
    for event in visits(drawn.building, range(windows)):
        begin = time.process_time()
        results = run.feed(event)
        cpu_s += time.process_time() - begin
        for _ in (r for r in results if isinstance(r, WindowReport)):
            spent.append(cpu_s)
            counted, cpu_s = counted + 1, 0.0
            if counted in AT:
                near = spent[-min(NEAR, max(counted // 2, 5)) :]
                costs.append(Cost(counted, 1e3 * float(np.median(near)), len(run.pipeline.snapshot()), resident_mb()))
    return costs


def resident_mb() -> float:
    """Memory of this process in RAM, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def table(costs: list[Cost]) -> str:
    """One row per stated window."""
    lines = [
        "| window | CPU for this window, ms | state, kB | memory of the process, MB |",
        "| --- | --- | --- | --- |",
    ]
    lines += [f"| {c.window} | {c.cpu_ms:.2f} | {c.snapshot_bytes / 1024:.1f} | {c.resident_mb:.1f} |" for c in costs]
    return "\n".join(lines)
