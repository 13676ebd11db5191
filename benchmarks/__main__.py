"""All figures, one after the other: `python -m benchmarks [NAME ...]`. Writes them into docs/performance.md."""

from __future__ import annotations

import importlib
import os
import sys

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as every entry point of the product, before numpy loads

NAMES = ("agent_cost", "four_sensors", "recording", "sums", "torture", "torture_shm")


def main() -> int:
    """Run the benchmarks named on the command line, or all."""
    names = sys.argv[1:] or NAMES
    unknown = [name for name in names if name not in NAMES]
    if unknown:
        print(f"no benchmark {', '.join(unknown)}; there are {', '.join(NAMES)}", file=sys.stderr)
        return 2
    for name in names:
        importlib.import_module(f"benchmarks.{name}").main()
    return 0


if __name__ == "__main__":
    sys.exit(main())
