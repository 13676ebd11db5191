"""`make faults`: injects all faults in full number, or only those named; writes the table in docs/reliability.md."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as every entry point of the product, before numpy loads

from benchmarks.page import machine, write_part
from tests.faults import clock, disk, flips, kill, needs, remembering, routing, states, unplug
from tests.faults.outcome import HEAD, Outcome, row

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reliability.md"
PART = "faults"
LINES: dict[str, Callable[[Path], Outcome]] = {
    "kill": partial(kill.at_random_moments, kills=200),
    "write": kill.at_every_write,
    "states": partial(states.killed, kills=20),
    "ext4": partial(disk.power_cut, kind="ext4", cuts=50),
    "xfs": partial(disk.power_cut, kind="xfs", cuts=50),
    "full": disk.full,
    "read-only": disk.read_only,
    "eio": disk.sync_fails,
    "slow": disk.slow,
    "slow-end": disk.slow_at_the_end,
    "unplug": partial(unplug.unplugged, times=100),
    "router": partial(routing.away, results=10_000, speed=50),
    "consumer": partial(remembering.killed, kills=60),
    "clock": clock.stepped,
    "state": partial(flips.of_state, flips=10_000),
    "starts": partial(flips.at_starts, starts=20),
    "recording": partial(flips.of_recording, flips=2000, size_bytes=1_000_000, edge_bytes=64),
}


def main() -> int:
    """Run the table lines named on the command line, or all of them; exit status 3 where a requirement fails."""
    names = sys.argv[1:] or list(LINES)
    if unknown := [name for name in names if name not in LINES]:
        print(f"no fault {', '.join(unknown)}; there are {', '.join(LINES)}", file=sys.stderr)
        return 2
    if missing := needs.missing():
        print(f"not here, and needed: {', '.join(missing)}", file=sys.stderr)
        return 1
    # With the highest priority on this machine, so that other processes do not disturb the measurement.
    os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    good = True
    for name in names:
        with tempfile.TemporaryDirectory(prefix="fieldcal-faults-") as directory:
            began_s = time.monotonic()
            outcome = LINES[name](Path(directory))
        print(outcome, f"{time.monotonic() - began_s:.0f} s", flush=True)
        good &= outcome.good
        _write(outcome)
    return 0 if good else 3


def _write(outcome: Outcome) -> None:
    """Replace the row of this line in the table; the other rows stay, each with the day of its own run."""
    page = PAGE.read_text().split(f"<!-- {PART}: begin -->", 1)[1].split(f"<!-- {PART}: end -->", 1)[0]
    known = [line for line in page.splitlines() if line.startswith("| ") and line not in HEAD.splitlines()]
    rows = {line.split(" | ", 1)[0]: line for line in known}
    day = time.strftime("%Y-%m-%d", time.gmtime())
    rows[f"| {outcome.line}"] = row(outcome, day)
    write_part(PART, f"{machine()}\n\n{HEAD}\n" + "\n".join(rows.values()))


if __name__ == "__main__":
    sys.exit(main())
