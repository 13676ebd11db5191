"""A pipeline in a process of its own, with what the agent loads: `python -m benchmarks.online.fed WINDOW ...`.

It reads a configuration (JSON) and then events, all pickled, from its standard input, and prints its costs at the named
windows, one JSON object a line.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pickle
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

import agent.acquisition.service  # noqa: F401 - what an agent loads takes memory too
from agent.acquisition.arena import one_arena, return_free
from agent.config import Config
from agent.core.events import Event, WindowReport
from agent.core.pipeline import Pipeline

NEAR = 200  # largest number of windows around each stated window; their median is reported


class Cost(NamedTuple):
    """Cost around one window: median CPU time of all events of a window (ms), size of the snapshot, memory of the
    process after it and at most until then."""

    window: int
    cpu_ms: float
    snapshot_bytes: int
    resident_mb: float
    peak_mb: float


def costs(config: Config, events: Iterator[Event], at: Sequence[int]) -> Iterator[Cost]:
    """Those of the windows numbered `at`."""
    pipeline, spent, cpu_s = Pipeline.begin(config, "run-1", 0, 0, {}), list[float](), 0.0
    for event in events:
        begin = time.process_time()
        found = sum(isinstance(result, WindowReport) for result in pipeline.step(event))
        if found:
            return_free()  # as the agent does
        cpu_s += time.process_time() - begin
        for _ in range(found):
            spent.append(cpu_s)
            cpu_s = 0.0
            if len(spent) in at:
                near = spent[-min(NEAR, max(len(spent) // 2, 5)) :]
                resident_mb, peak_mb = memory_mb("VmRSS"), memory_mb("VmHWM")
                yield Cost(len(spent), 1e3 * float(np.median(near)), len(pipeline.snapshot()), resident_mb, peak_mb)


def memory_mb(name: str) -> float:
    """A line of the kernel on the memory of this process, MB."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024


def read() -> Iterator[Event]:
    """The events until the end of the input."""
    while True:
        try:
            yield pickle.load(sys.stdin.buffer)
        except EOFError:
            return


if __name__ == "__main__":
    one_arena()
    config = Config.model_validate_json(pickle.load(sys.stdin.buffer))
    for cost in costs(config, read(), list(map(int, sys.argv[1:]))):
        print(msgspec.json.encode(cost).decode(), flush=True)
