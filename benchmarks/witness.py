"""How long the machine itself stood still while something was measured: a process a CPU that only sleeps.

What is late beside an idle witness was held up by the machine (its host, its kernel, real-time neighbours), not by
what is measured.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

SLEEP_S = 0.001
PRIORITY = 10  # of what is measured; the witness's is one more
Late = tuple[float, float]
"""When it should have woken (CLOCK_MONOTONIC) and by how much it was late, s."""


def before_others() -> bool:
    """Take this process, and all that it starts, before the rest of the machine; False where that is not allowed."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    return True


class Witness:
    """Watches all CPUs from its making until `result`."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "benchmarks.witness"]
        cpus = sorted(os.sched_getaffinity(0))
        self._watching = [subprocess.Popen([*command, str(cpu)], stdout=subprocess.PIPE, text=True) for cpu in cpus]

    def result(self, least_s: float) -> list[Late]:
        """Stop, and tell of all that was late by more than `least_s`, in order of time."""
        found: list[Late] = []
        for process in self._watching:
            process.terminate()
            for line in process.communicate()[0].splitlines():
                due_s, late_s = map(float, line.split())
                found += [(due_s, late_s)] if late_s > least_s else []
        return sorted(found)


def watch(cpu: int) -> None:
    """Sleep on this CPU until told to stop; then print a line for each time it was late by more than `SLEEP_S`."""
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
