"""Cost of a window in a long run: CPU time of the pipeline, its state and its memory, from window 10 to 10,000."""

from __future__ import annotations

import pickle
import subprocess
import sys

import msgspec

from benchmarks.online.fed import Cost
from benchmarks.online.node import Timing, node
from benchmarks.online.runner import visits

TIMING = Timing(10.0, 3600.0, 10_000)
AT = (10, 100, 1000, 10_000)


def measure(windows: int = TIMING.windows) -> list[Cost]:
    """Simulate one run of `windows` windows, an hour apart, at 100 Hz. The pipeline is in a process of its own, so that
    its memory is not that of the simulation."""
    drawn = node(1, all_axes=True, timing=TIMING)
    command = [sys.executable, "-m", "benchmarks.online.fed", *map(str, AT)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as fed:
        assert fed.stdin is not None
        assert fed.stdout is not None
        pickle.dump(drawn.config.model_dump_json(), fed.stdin)
        for event in visits(drawn.building, range(windows)):
            pickle.dump(event, fed.stdin)
        fed.stdin.close()
        found = [msgspec.json.decode(line, type=Cost) for line in fed.stdout]
    if fed.returncode:
        raise SystemExit(f"benchmarks.online.fed: exit status {fed.returncode}")
    return found


def table(costs: list[Cost]) -> str:
    """One row per stated window."""
    lines = [
        "| window | CPU for this window, ms | state, kB | memory of the process, MB | at most until then, MB |",
        "| --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {c.window} | {c.cpu_ms:.2f} | {c.snapshot_bytes / 1000:.1f} | {c.resident_mb:.1f} | {c.peak_mb:.1f} |"
        for c in costs
    ]
    return "\n".join(lines)
