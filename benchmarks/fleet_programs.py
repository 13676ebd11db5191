"""What `benchmarks.fleet_scale` runs and measures: programs that can be killed, what they use, a reader of the page."""

from __future__ import annotations

import http.client
import multiprocessing
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from itertools import cycle
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import psutil

ROOT = Path(__file__).resolve().parents[1]
COMMAND = "import sys; from agent.cli.main import run_cli; sys.exit(run_cli(sys.argv[1:]))"
PROBE_S = 0.5  # s between two requests to the page; a page asks when something has changed, at most once a second
LOOK_S = 1.0  # s between two looks at what programs use
PEAK_S = 10.0  # s over which the largest share of a core is told


class Program:
    """`fieldcal` with these arguments, as a process that can be killed and started again."""

    def __init__(self, log: Path, *arguments: str) -> None:
        self._arguments, self._log = arguments, log
        self._process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        with self._log.open("ab") as log:
            command = [sys.executable, "-c", COMMAND, *self._arguments]
            return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)

    def pids(self) -> list[int]:
        """Its process and the processes of that one."""
        return tree(self._process.pid)

    def away(self, for_s: float, stop: threading.Event) -> None:
        """Kill -9 it, and start it again after `for_s`."""
        self._process.kill()
        self._process.wait()
        stop.wait(for_s)
        self._process = self._start()

    def end(self) -> None:
        """End it."""
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def tree(pid: int) -> list[int]:
    """A process and all that it has started."""
    try:
        return [pid, *(child.pid for child in psutil.Process(pid).children(recursive=True))]
    except psutil.NoSuchProcess:
        return []


class Used(NamedTuple):
    """Shares of one core in %, mean and the largest over PEAK_S; the largest memory in MB (PSS)."""

    mean_pct: float
    peak_pct: float
    memory_mb: float


class Usage(threading.Thread):
    """What groups of processes use, from now until `stop`. A process that is killed counts up to the last look."""

    def __init__(self, groups: dict[str, Callable[[], Sequence[int]]], stop: threading.Event) -> None:
        super().__init__(daemon=True)
        self._groups, self._stop_looking = groups, stop
        self._cpu_s: dict[str, dict[int, float]] = defaultdict(dict)  # by process, of those that ended too
        self._looks: dict[str, list[tuple[float, float]]] = defaultdict(list)  # (monotonic time, CPU time), in s
        self._memory_mb: dict[str, float] = defaultdict(float)

    def run(self) -> None:
        """Look until it is to stop."""
        while not self._stop_looking.wait(LOOK_S):
            for name, pids in self._groups.items():
                self._look(name, pids())

    def _look(self, name: str, pids: Sequence[int]) -> None:
        memory = 0.0
        for pid in pids:
            try:
                process = psutil.Process(pid)
                spent = process.cpu_times()
                self._cpu_s[name][pid] = spent.user + spent.system
                memory += process.memory_full_info().pss / 1e6
            except psutil.NoSuchProcess:
                continue
        self._memory_mb[name] = max(self._memory_mb[name], memory)
        self._looks[name].append((time.monotonic(), sum(self._cpu_s[name].values())))

    def used(self, name: str) -> Used:
        """What a group has used."""
        looks = self._looks[name]
        shares = [
            100 * (b[1] - a[1]) / (b[0] - a[0]) for a, b in zip(looks, looks[round(PEAK_S / LOOK_S) :], strict=False)
        ]
        (first_s, first_cpu_s), (last_s, last_cpu_s) = looks[0], looks[-1]
        return Used(100 * (last_cpu_s - first_cpu_s) / (last_s - first_s), max(shares, default=0.0),
                    self._memory_mb[name])  # fmt: skip


class Asked(NamedTuple):
    """A request: its path, when it began (monotonic time), s until the whole answer was there, and its bytes."""

    path: str
    at_s: float
    took_s: float
    size: int


class Probe:
    """A process of its own that asks the page for these paths in turn. While the monitor is away nothing is noted."""

    def __init__(self, port: int, paths: Sequence[str]) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=_ask, args=(other, port, paths), daemon=True)
        self._process.start()

    def end(self) -> list[Asked]:
        """End it; what it asked."""
        self._connection.send(None)
        asked: list[Asked] = self._connection.recv()
        self._process.join()
        return asked


def _ask(connection: Connection, port: int, paths: Sequence[str]) -> None:
    asked: list[Asked] = []
    turns = cycle(paths)
    while not connection.poll(PROBE_S):
        path, began_s = next(turns), time.monotonic()
        try:
            page = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
            page.request("GET", path)
            size = len(page.getresponse().read())
            page.close()
        except (OSError, http.client.HTTPException):
            continue
        asked.append(Asked(path, began_s, time.monotonic() - began_s, size))
    connection.send(asked)
