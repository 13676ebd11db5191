"""Run the on-line scenarios: `python -m benchmarks.online [NAME ...] [--write] [--workers N] [--runs N]`."""

from __future__ import annotations

import os
import sys

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as in every entry point of the product; must be set before numpy is loaded

from benchmarks.online.pages import main

if __name__ == "__main__":
    sys.exit(main())
