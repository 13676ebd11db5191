"""Memory, time and size of a UFF file, for numbers of samples of three axes with accelerations.

python -m benchmarks.uff 10000 600000 2000000
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

RATE_HZ, BLOCK = 1000.0, 500
ONE = "from benchmarks.uff import measure; measure({count})"


def measure(count: int) -> None:
    """Write one file and print a row of the table."""
    import resource
    import tempfile
    import time
    from pathlib import Path

    import numpy as np

    from agent.export.samples import ExportedSamples, RecordedContent
    from agent.export.uff import write_uff
    from tests.unit.results import calibration

    random = np.random.default_rng(1)

    def blocks() -> Iterator[ExportedSamples]:
        for first in range(0, count, BLOCK):
            times = 1_700_000_000 * 10**9 + (np.arange(first, first + BLOCK) * 1e9 / RATE_HZ).astype(np.int64)
            values = random.integers(-(1 << 19), 1 << 19, (BLOCK, 3)).astype(float)
            yield ExportedSamples(times, values, values / 26000.0, first, RATE_HZ, None)

    with tempfile.TemporaryDirectory() as directory:
        path, begun = Path(directory) / "a.uff", time.process_time()
        write_uff(path, RecordedContent("mems", "count", 3, [calibration(1)]), blocks())
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        size_mb, took_s = path.stat().st_size / 1e6, time.process_time() - begun
    print(f"| {count} | {size_mb:.0f} | {took_s:.1f} | {peak_mb:.0f} |", flush=True)


def main() -> None:
    """A process for each number of samples, since memory is that of a process."""
    print("| samples | file, MB | CPU time, s | peak memory, MB |\n| --- | --- | --- | --- |", flush=True)
    for count in map(int, sys.argv[1:]):
        subprocess.run([sys.executable, "-c", ONE.format(count=count)], check=True)


if __name__ == "__main__":
    main()
