"""Entry point. What must be set before numpy loads is set here, since one thread gives the same bits on any machine."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Run the command line; see `fieldcal --help`."""
    # scipy carries its own OpenBLAS beside numpy's; both read this when they load, and sums over another number of
    # threads differ in the last bit.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    from agent.cli import run_cli

    sys.exit(run_cli())


if __name__ == "__main__":
    main()
