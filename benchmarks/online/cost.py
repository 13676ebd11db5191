"""What a window costs as a run grows long: time of the pipeline and the size of its state, window 10 to 10,000."""

from __future__ import annotations

import gc
import time
import tracemalloc
from collections import deque
from dataclasses import dataclass

import numpy as np

from agent.events import WindowReport
from benchmarks.online.node import Timing, node
from benchmarks.online.runner import Run, visits

TIMING = Timing(10.0, 3600.0, 10_000)
AT = (10, 100, 1000, 10_000)
NEAR = 200  # windows around each, at most; the median of them is told


@dataclass(frozen=True, slots=True)
class Cost:
    """Around one window: CPU time of all events of a window (ms, median), state (bytes of the snapshot), memory."""

    window: int
    cpu_ms: float
    snapshot_bytes: int
    traced_kb: float


def measure(windows: int = TIMING.windows) -> list[Cost]:
    """One run of so many windows, an hour apart, at 100 Hz."""
    drawn = node(1, all_axes=True, timing=TIMING)
    run = Run(drawn.config)
    tracemalloc.start()
    spent: deque[float] = deque(maxlen=NEAR)
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
                near = list(spent)[-max(counted // 2, 5) :]
                gc.collect()  # what nothing holds any more is no growth
                memory = tracemalloc.get_traced_memory()[0]
                costs.append(Cost(counted, 1e3 * float(np.median(near)), len(run.pipeline.snapshot()), memory / 1024))
    tracemalloc.stop()
    return costs


def table(costs: list[Cost]) -> str:
    """A row a window number."""
    lines = ["| window | CPU a window, ms | state, kB | Python memory in use, kB |", "| --- | --- | --- | --- |"]
    lines += [f"| {c.window} | {c.cpu_ms:.2f} | {c.snapshot_bytes / 1024:.1f} | {c.traced_kb:.0f} |" for c in costs]
    return "\n".join(lines)
