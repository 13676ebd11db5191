"""Entry point. What must be set before numpy loads is set here, since one thread gives the same bits on any machine."""

from __future__ import annotations

import os
import sys

from agent.cli.stopping import end_at_once_by_signals
from agent.delivery.ending import ProcessEnd, raise_every_interrupt

EXIT_S = 10.0  # s for what a command leaves behind: exit handlers, and threads that wait for Zenoh or a device


def main() -> None:
    """Run the command line; see `fieldcal --help`."""
    if sys.argv[1:2] == ["run"]:
        end_at_once_by_signals()
    elif sys.platform != "win32":
        raise_every_interrupt()
    ending = ProcessEnd()
    # scipy carries its own OpenBLAS beside numpy's; both read this when they load, and sums over another number of
    # threads differ in the last bit.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    # Arrow's own allocator gives pages back and asks for them again: for an hour of 1 kHz in text that takes 0.1 to
    # 0.2 s of CPU and 40 MB more.
    os.environ["ARROW_DEFAULT_MEMORY_POOL"] = "system"
    # No other package's plug-in of pydantic reads configurations; to look for one takes 2 % of the start.
    os.environ["PYDANTIC_DISABLE_PLUGINS"] = "__all__"
    try:
        from agent.terminal.text import guard_standard_streams

        guard_standard_streams()
        from agent.cli.main import run_cli

        ending.status = run_cli()
        ending.within(EXIT_S)
    except KeyboardInterrupt:  # while modules load
        ending.status = 130
    sys.exit(ending.status)


if __name__ == "__main__":
    main()
