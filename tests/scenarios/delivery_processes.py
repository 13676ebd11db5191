"""A gateway's store with publisher, and a consumer, each as a process that tests can disconnect and kill."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.scenarios.processes import ROOT

GATEWAY = """
import sys, time
from pathlib import Path
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from tests.unit.zenoh_site import record
store = Store(Path(sys.argv[1]))
publisher = Publisher("site", "gw", [sys.argv[2]], store)
publisher.start()
number = store.last_sequence()
print(number, flush=True)
for line in sys.stdin:
    count, size, pause_s = line.split()
    longest_s = 0.0
    for _ in range(0, int(count), 10):
        batch = [record(number + k, text="x" * int(size)) for k in range(1, 11)]
        number += 10
        store.commit(batch)  # what the recording's thread does; its disk is not this test's subject
        began_s = time.monotonic()
        for result in batch:
            publisher.publish(result)
        longest_s = max(longest_s, time.monotonic() - began_s)
        time.sleep(float(pause_s))
    print(number, longest_s, store.published(), flush=True)
publisher.close()
store.close()
"""
CONSUMER = """
import sys
from pathlib import Path
from agent.delivery.consumer import Consumer
with Consumer([sys.argv[1]], memory=Path(sys.argv[2])) as consumer, open(sys.argv[3], "a") as out:
    for result in consumer:
        out.write(f"{result.sequence}\\n")
        out.flush()
"""


@contextmanager
def process(*arguments: str | Path) -> Iterator[subprocess.Popen[str]]:
    """Run Python with these arguments; the process is killed at the end if it still runs."""
    command = [sys.executable, *map(str, arguments)]
    running = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield running
    finally:
        if running.poll() is None:
            running.kill()
        running.communicate()


@contextmanager
def router(endpoint: str) -> Iterator[subprocess.Popen[str]]:
    """Run `fieldcal router`; it listens already when this returns."""
    with process("-m", "agent", "router", "--listen", endpoint) as running:
        assert running.stdout is not None
        assert endpoint in running.stdout.readline()
        yield running


class Gateway:
    """The gateway's process. `begin` is the number before its first result."""

    def __init__(self, running: subprocess.Popen[str]) -> None:
        self._process = running
        self.begin = int(self._line())

    def send(self, count: int, *, size: int = 100, pause_s: float = 0.0) -> None:
        """Make it commit and publish `count` results, ten at a time."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{count} {size} {pause_s}\n")
        self._process.stdin.flush()

    def sent(self) -> tuple[int, float, int]:
        """Wait until all are handed over: (last number, longest time to hand over ten in s, last published number)."""
        number, longest_s, published = self._line().split()
        return int(number), float(longest_s), int(published)

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()


def free_endpoint() -> str:
    """An endpoint on this machine with a port that is not in use."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{listener.getsockname()[1]}"


def numbers(path: Path) -> list[int]:
    """The numbers that a consumer has written, in complete lines."""
    return [int(line) for line in path.read_text().split("\n")[:-1]] if path.exists() else []
