"""Run all benchmarks, one after the other: `python -m benchmarks [NAME ...]`.

Writes the figures into docs/performance.md.
"""

from __future__ import annotations

import importlib
import os
import sys

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as in every entry point of the product; must be set before numpy is loaded

NAMES = ("agent_cost", "four_sensors", "recording", "sums", "torture", "torture_shm")


def main() -> int:
    """Run the benchmarks named on the command line, or all without names."""
    names = sys.argv[1:] or NAMES
    unknown = [name for name in names if name not in NAMES]
    if unknown:
        print(f"no benchmark {', '.join(unknown)}; available: {', '.join(NAMES)}", file=sys.stderr)
        return 2
    for name in names:
        importlib.import_module(f"benchmarks.{name}").main()
    return 0


if __name__ == "__main__":
    sys.exit(main())
