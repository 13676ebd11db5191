"""A start that takes long, because of large or hostile files in the data directory, ends when it is told."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from agent.cli import stopping
from agent.delivery.router import router_running
from tests.faults.rig import free_port
from tests.scenarios.processes import ROOT, START_S, wait_until

# Stands for a start that takes long: in Python, and in one call of a library that no signal interrupts.
SLOW = """
import sys, threading, hashlib
from agent.acquisition import service
def slow(*_, **__):
    print("slow", flush=True)
    {what}
service.Store = slow
from agent.cli import run
from agent.cli.main import run_cli
run.LOOPBACK = sys.argv[2]
sys.exit(run_cli(["run", "--with-router", "--data-dir", sys.argv[1]]))
"""
CALLS = {
    "python": """
    while True:
        try:
            threading.Event().wait()  # for ever
        except Exception:
            pass""",
    "library": "hashlib.pbkdf2_hmac('sha256', b'', b'', 2_000_000_000)",
}


# Stands for a module that takes long to load, and takes every exception for a fault of what it imports.
SLOW_MODULE = """
import threading
print("slow", flush=True)
while True:
    try:
        threading.Event().wait()  # for ever
    except BaseException:
        {what}
"""


@contextmanager
def slow(
    command: Sequence[str | Path], variables: Mapping[str, str] | None = None, **more: Any
) -> Iterator[subprocess.Popen[str]]:
    """A process that has just said "slow"."""
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(
        [*map(str, command)], cwd=ROOT, env={**os.environ, **(variables or {})}, **pipes, **more
    ) as process:
        try:
            until_said(process, "slow")
            yield process
        finally:
            process.kill()


def until_said(process: subprocess.Popen[str], line: str) -> None:
    """Wait until a process has said this line."""
    assert process.stdout is not None
    while (said := process.stdout.readline()) != f"{line}\n":
        assert said, f"it ended before it said {line}"


def told(process: subprocess.Popen[str], number: signal.Signals) -> tuple[int, str]:
    """Exit status of a process that gets a signal, and what it said on standard error. By itself it would never end."""
    process.send_signal(number)
    said = process.communicate(timeout=START_S)[1]
    return process.returncode, said


def test_a_start_in_a_call_that_no_signal_interrupts_has_less_than_two_seconds() -> None:
    assert stopping.LONGEST_S < 2.0


@pytest.mark.one_case
@pytest.mark.parametrize("what", CALLS)
def test_a_signal_ends_a_start_and_its_router(tmp_path: Path, what: str) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with slow([sys.executable, "-c", SLOW.replace("{what}", CALLS[what]), tmp_path / "data", endpoint]) as process:
        wait_until(lambda: router_running(endpoint), START_S, "the router runs")
        status, said = told(process, signal.SIGTERM)
        assert status == 0
        assert "Traceback" not in said
    wait_until(lambda: not router_running(endpoint), START_S, "the router has ended")


def test_a_second_signal_does_not_cut_off_what_the_first_one_closes(tmp_path: Path) -> None:
    closing = """
    try:
        print("open", flush=True)
        threading.Event().wait()
    finally:
        print("closing", flush=True)
        sys.stdin.readline()
        print("closed", flush=True)"""
    command: list[str | Path] = [
        sys.executable,
        "-c",
        SLOW.replace("{what}", closing),
        tmp_path / "data",
        f"tcp/127.0.0.1:{free_port()}",
    ]
    with slow(command, stdin=subprocess.PIPE) as process:
        until_said(process, "open")
        process.send_signal(signal.SIGINT)
        until_said(process, "closing")
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGTERM)
        out, said = process.communicate("\n", timeout=START_S)
        assert (process.returncode, said) == (0, "stopped before the start was complete\n")
        assert out.startswith("closed\n")


@pytest.mark.parametrize(
    ("module", "number"),
    [
        ("pydantic", signal.SIGINT),
        ("pydantic", signal.SIGTERM),
        ("pydantic", signal.SIGHUP),
        ("serial", signal.SIGTERM),  # loaded with the driver that the configuration names
    ],
)
def test_a_signal_ends_a_run_while_modules_load(tmp_path: Path, module: str, number: signal.Signals) -> None:
    (tmp_path / f"{module}.py").write_text(SLOW_MODULE.replace("{what}", "pass"))
    with slow([sys.executable, "-m", "agent", "run"], {"PYTHONPATH": str(tmp_path)}) as process:
        assert told(process, number) == (0, "stopped before the start was complete\n")


def test_ctrl_c_while_modules_load_is_130_for_the_other_commands(tmp_path: Path) -> None:
    (tmp_path / "pydantic.py").write_text(SLOW_MODULE.replace("{what}", "raise"))
    with slow([sys.executable, "-m", "agent", "check", "c.toml"], {"PYTHONPATH": str(tmp_path)}) as process:
        assert told(process, signal.SIGINT) == (130, "\ninterrupted\n")


def test_a_run_under_nohup_goes_on_after_a_hangup(tmp_path: Path) -> None:
    (tmp_path / "pydantic.py").write_text(SLOW_MODULE.replace("{what}", "pass"))
    command = ["nohup", sys.executable, "-m", "agent", "run"]
    with slow(command, {"PYTHONPATH": str(tmp_path)}) as process:
        process.send_signal(signal.SIGHUP)
        status = Path(f"/proc/{process.pid}/status").read_text()
        ignored = int(status.split("SigIgn:")[1].split()[0], 16)
        assert ignored >> (signal.SIGHUP - 1) & 1
        assert told(process, signal.SIGTERM)[0] == 0
