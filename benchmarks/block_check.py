"""How long the check of a driver's block takes, which the agent does for each block before its queue.

`python -m benchmarks.block_check` prints the median over the blocks, in microseconds.
"""

from __future__ import annotations

import time

import numpy as np

from hw.block import DeviceInfo, SampleBlock
from hw.promises import BlockCheck
from hw.sensor import boot_id, system_clock

BLOCKS = 2000
KINDS = ((50, 5), (500, 25), (500, 250), (50_000, 25))  # samples and bursts of a block


def main() -> None:
    """Print a line for each kind of block."""
    for n, bursts in KINDS:
        print(f"{n} samples in {bursts} bursts: {_median_us(n, bursts):.1f} us")


def _median_us(n: int, bursts: int) -> float:
    check = BlockCheck("imu", DeviceInfo("none", "none", "", "count", 3, 1000.0), system_clock())
    counts = np.linspace(n // bursts, n, bursts).astype(np.int32)
    indications = np.zeros((n, 3), np.int32)
    taken_ns = []
    for k in range(BLOCKS):
        arrival_ns, utc_ns = system_clock()
        arrivals_ns = arrival_ns - np.arange(bursts, dtype=np.int64)[::-1]
        block = SampleBlock("imu", boot_id(), utc_ns, k * n, 1000.0, arrivals_ns, counts, indications)
        before_ns = time.perf_counter_ns()
        check.taken(block)
        taken_ns.append(time.perf_counter_ns() - before_ns)
    return float(np.median(taken_ns)) * 1e-3


if __name__ == "__main__":
    main()
