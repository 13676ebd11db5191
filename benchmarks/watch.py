"""What the hourly watch of a sensor without a reference costs: time of one processor core, and memory.

    python -m benchmarks.watch [--rate-hz 1000] [--minutes 5]

Blocks of half a second go through `agent.core.watch.SensorWatch` alone; the time of a whole run without it is that of
`benchmarks.agent_cost`. The share is CPU time over the time of the data. Kept: what the channel holds when its hour and
its minute are full, in the snapshot. The memory for a moment is what tracemalloc sees above that; channels take turns,
so that it is needed once for all of them.
"""

from __future__ import annotations

import argparse
import sys
import time
import tracemalloc

import numpy as np

from agent.core.snapshot import pack
from agent.core.watch import SensorWatch
from calib.estimate.correction import Law
from calib.signal.spectra import bands_of
from hw.block import BlockFlags, SampleBlock

BLOCK_S, SECOND = 0.5, 1_000_000_000
HOUR = 500_000 * 3600 * SECOND  # the begin of an hour of UTC
SOUND = np.zeros(3, dtype=bool)
LAW = Law(np.append(np.eye(3).ravel(), np.zeros(3)), 1e-6 * np.eye(12))


def blocks(rate_hz: float, minutes: int) -> list[SampleBlock]:
    """Counts of a sensor at rest, noise of 100 counts; the same half second again and again."""
    n = round(BLOCK_S * rate_hz)
    counts = np.random.default_rng(1).normal([0.0, 0.0, 256_000.0], 100.0, (n, 3)).astype(np.int32)
    found = []
    for k in range(round(60 * minutes / BLOCK_S)):
        end = HOUR + round((k + 1) * BLOCK_S * SECOND)
        flags = BlockFlags.NONE if k else BlockFlags.RESTART
        burst = np.array([end]), np.array([n], dtype=np.int32)
        found.append(SampleBlock("s", "boot", end, k * n, rate_hz, *burst, counts, flags, None, 20.0))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--rate-hz", type=float, default=1000.0)
    parser.add_argument("--minutes", type=int, default=5)
    options = parser.parse_args()
    made = blocks(options.rate_hz, options.minutes)
    bands_of(options.rate_hz)
    watch, began_s = SensorWatch(), time.process_time()
    for block in made:
        watch.update(block, SOUND, LAW)
    share = (time.process_time() - began_s) / (60.0 * options.minutes)
    tracemalloc.start()
    watch = SensorWatch()
    for block in made:
        watch.update(block, SOUND, LAW)
    now, at_once = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    state = watch.snapshot()
    full = (state["segments"] * 60)[:60]
    samples = bands_of(options.rate_hz).samples
    kept = len(pack(state | {"segments": full, "held": np.zeros((3, samples), dtype=np.float32) + 1.0}))
    watch.load(state | {"segments": full})
    began_s = time.process_time()
    hour = watch.tick(HOUR + 2 * 3600 * SECOND, 0.0, LAW)
    closing_s = time.process_time() - began_s
    print(f"{options.rate_hz:g} Hz, {len(hour.centre_hz) if hour else 0} bands:")
    print(
        f"  {100.0 * (share + closing_s / 3600.0):.2f} % of one core; the end of an hour takes {1e3 * closing_s:.0f} ms"
    )
    print(f"  {kept / 1e6:.2f} MB kept; {(at_once - now) / 1e6:.2f} MB more for a moment at the end of each minute")
    return 0


if __name__ == "__main__":
    sys.exit(main())
