"""Pauses of the machine during a measurement: one process per CPU that only sleeps.

If the idle witness was late at the same time, the machine (its host, its kernel, real-time processes) caused the delay
and not the measured process.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

SLEEP_S = 0.001
PRIORITY = 10  # of the measured process; the witness has one more
Late = tuple[float, float]
"""Time at which the witness should have woken (CLOCK_MONOTONIC) and its delay, s."""


def before_others() -> bool:
    """Give this process and its children priority over the rest of the machine; False if this is not permitted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    return True


class Witness:
    """Watches all CPUs from its construction until `result`."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "benchmarks.witness"]
        cpus = sorted(os.sched_getaffinity(0))
        self._watching = [subprocess.Popen([*command, str(cpu)], stdout=subprocess.PIPE, text=True) for cpu in cpus]

    def result(self, least_s: float) -> list[Late]:
        """Stop and return all delays of more than `least_s`, in order of time."""
        found: list[Late] = []
        for process in self._watching:
            process.terminate()
            for line in process.communicate()[0].splitlines():
                due_s, late_s = map(float, line.split())
                found += [(due_s, late_s)] if late_s > least_s else []
        return sorted(found)


def watch(cpu: int) -> None:
    """Sleep on this CPU until a request to stop; then print one line per delay of more than `SLEEP_S`."""
    stopped = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopped.set())
    os.sched_setaffinity(0, {cpu})
    if os.sched_getscheduler(0) == os.SCHED_FIFO:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY + 1))
    late: list[Late] = []
    while not stopped.is_set():
        due_s = time.monotonic() + SLEEP_S
        time.sleep(SLEEP_S)
        late_s = time.monotonic() - due_s
        if late_s > SLEEP_S:
            late.append((due_s, late_s))
    for due_s, late_s in late:
        print(due_s, late_s)


if __name__ == "__main__":
    watch(int(sys.argv[1]))
