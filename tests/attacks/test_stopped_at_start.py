"""A start that takes long, because of large or hostile files in the data directory, ends when it is told."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.scenarios.processes import ROOT

# Stands for a start that takes long: in Python, and in one call of a library that no signal interrupts.
SLOW = """
import sys, threading, hashlib
from agent.acquisition import service
def slow(*_, **__):
    print("slow", flush=True)
    {what}
service.Store = slow
from agent.cli.main import run_cli
sys.exit(run_cli(["run", "--data-dir", sys.argv[1]]))
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


@pytest.mark.parametrize("what", CALLS)
def test_a_signal_ends_a_start_within_two_seconds(tmp_path: Path, what: str) -> None:
    command = [sys.executable, "-c", SLOW.replace("{what}", CALLS[what]), str(tmp_path / "data")]
    with subprocess.Popen(command, cwd=ROOT, env=os.environ, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            while process.stdout.readline() not in ("slow\n", ""):
                pass
            told_s = time.monotonic()
            process.send_signal(signal.SIGTERM)
            assert process.wait(10) == 0
            assert time.monotonic() - told_s < 2.5  # the machine may be busy
        finally:
            process.kill()
