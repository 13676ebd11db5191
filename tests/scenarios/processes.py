"""Starts the real program as a user does, and reads its output files."""

from __future__ import annotations

import json
import os
import pty
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
START_S = 60.0  # s allowed for a start; it takes about 1 s, on a machine under load more


def fieldcal(*arguments: str | Path, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    """Run a `fieldcal` command to its end."""
    command = [sys.executable, "-m", "agent", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=timeout_s, check=False)


def answered(*arguments: str | Path, typed: str) -> None:
    """Run a `fieldcal` command on a terminal, where somebody has `typed` all answers, to its end with status 0."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "agent", *map(str, arguments)],
        stdin=theirs, stdout=theirs, stderr=theirs, cwd=ROOT, start_new_session=True,
    )  # fmt: skip
    os.close(theirs)
    os.write(ours, typed.encode())
    said = b""
    try:
        while data := os.read(ours, 4096):
            said += data
    except OSError:  # the other side is closed
        pass
    assert process.wait(START_S) == 0, said.decode()


@contextmanager
def started(*arguments: str | Path, output: Path, directory: Path = ROOT) -> Iterator[subprocess.Popen[bytes]]:
    """Start a command that keeps running, with its output in the file `output`. It is killed at the end if it runs."""
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


def interrupt(process: subprocess.Popen[Any]) -> float:
    """Interrupt a process as Ctrl-C does; returns the time that it took to end, in s."""
    began_s = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.wait(timeout=START_S)
    return time.monotonic() - began_s


def wait_until(condition: Any, timeout_s: float, what: str, every_s: float = 0.05) -> Any:
    """Wait until `condition()` is true and return its value. Fails after `timeout_s`; `what` names what was awaited.

    `every_s`: how often to ask.
    """
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        value = condition()
        if value:
            return value
        time.sleep(every_s)  # polls; the condition decides, not the time
    raise AssertionError(f"{what}: not within {timeout_s:g} s")


def results(data_dir: Path, what: str) -> list[dict[str, Any]]:
    """Results of the kind `what` in the store of a data directory, in order; empty where there is no store yet."""
    path = data_dir / "state.sqlite"
    if not path.exists():
        return []
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    try:
        rows = connection.execute("SELECT payload FROM results WHERE what = ? ORDER BY sequence", (what,)).fetchall()
    except sqlite3.OperationalError:  # the agent has not made its tables yet
        return []
    finally:
        connection.close()
    return [json.loads(payload) for (payload,) in rows]


def recordings(data_dir: Path) -> list[Path]:
    """All recordings, finished or not, in order."""
    return sorted([*data_dir.glob("*.mcap"), *data_dir.glob("*.mcap.active")])
