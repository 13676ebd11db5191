"""Opens idle connections to the fleet page, asks it meanwhile, and measures its log.

    .venv/bin/python -m benchmarks.idle_connections [--count 1024] [--seconds 30]

The program may have 1,024 open files, as by default on Debian. A connection that the server closes is opened again.
"""

from __future__ import annotations

import argparse
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import closing, suppress
from urllib.request import urlopen

FILES = 1024
ANSWER_S = 5.0


def measure(count: int, seconds: float) -> None:
    """Print what a reader and the log of the monitor see."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (4 * count, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    with closing(socket.create_server(("127.0.0.1", 0))) as free:
        address = free.getsockname()
    with tempfile.TemporaryDirectory() as directory, tempfile.TemporaryFile() as log:
        command = [sys.executable, "-m", "agent", "monitor", "--listen", f"127.0.0.1:{address[1]}",
                   "--data-dir", directory]  # fmt: skip
        monitor = subprocess.Popen(["prlimit", f"--nofile={FILES}", *command], stdout=log, stderr=log)
        while not answers(address):
            time.sleep(0.2)
        before, asked = log.seek(0, 2), []
        idle: list[socket.socket] = []
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            idle = [each for each in idle if is_open(each)]
            with suppress(OSError):
                while len(idle) < count:
                    idle.append(socket.create_connection(address, 1.0))
                    idle[-1].setblocking(False)
            asked.append(answers(address))
            time.sleep(0.5)
        written = log.seek(0, 2) - before
        monitor.send_signal(signal.SIGINT)
        monitor.wait(20)
    print(f"{count} idle connections for {seconds:g} s: {sum(asked)} of {len(asked)} requests answered within "
          f"{ANSWER_S:g} s; {written / 1e3:.1f} kB of log")  # fmt: skip


def answers(address: tuple[str, int]) -> bool:
    with suppress(OSError), urlopen(f"http://{address[0]}:{address[1]}/api/fleet", timeout=ANSWER_S) as answer:
        return bool(answer.status == 200)
    return False


def is_open(connection: socket.socket) -> bool:
    try:
        return bool(connection.recv(1))
    except BlockingIOError:
        return True
    except OSError:
        return False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1024)
    parser.add_argument("--seconds", type=float, default=30.0)
    given = parser.parse_args()
    measure(given.count, given.seconds)


if __name__ == "__main__":
    main()
