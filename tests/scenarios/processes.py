"""Starts the real program, as a user would, and reads what it leaves."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
START_S = 20.0  # a start takes about one second; a machine under load gets twenty


def fieldcal(*arguments: str | Path, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    command = [sys.executable, "-m", "agent", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=timeout_s, check=False)


@contextmanager
def started(*arguments: str | Path, output: Path, directory: Path = ROOT) -> Iterator[subprocess.Popen[bytes]]:
    """A command that goes on; killed at the end if it still runs. Its output goes to a file."""
    with open(output, "ab") as file:
        process = subprocess.Popen(
            [sys.executable, "-u", "-m", "agent", *map(str, arguments)],
            cwd=directory,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()


def interrupt(process: subprocess.Popen[bytes]) -> float:
    """Ctrl-C; returns how long it took to end, in s."""
    began_s = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.wait(timeout=START_S)
    return time.monotonic() - began_s


def wait_until(condition: Any, timeout_s: float, what: str) -> Any:
    """What `condition()` returns once it is true. Fails after `timeout_s`."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        value = condition()
        if value:
            return value
        time.sleep(0.05)  # polls; the condition decides, not the time
    raise AssertionError(f"{what}: not within {timeout_s:g} s")


def results(data_dir: Path, what: str) -> list[dict[str, Any]]:
    """Results of one kind in a data directory's store, in order; empty before there is a store."""
    path = data_dir / "state.sqlite"
    if not path.exists():
        return []
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    try:
        rows = connection.execute("SELECT payload FROM results WHERE what = ? ORDER BY sequence", (what,)).fetchall()
    except sqlite3.OperationalError:  # the agent is making its tables
        return []
    finally:
        connection.close()
    return [json.loads(payload) for (payload,) in rows]


def recordings(data_dir: Path) -> list[Path]:
    """All recordings, finished or not, in order."""
    return sorted([*data_dir.glob("*.mcap"), *data_dir.glob("*.mcap.active")])
