"""Leads a program that asks: each prompt gets an answer, as a person would type it."""

from __future__ import annotations

import os
import selectors
import subprocess
import sys
import time
from collections.abc import Callable

from tests.scenarios.processes import ROOT

SESSION_S = 500.0  # on a busy machine; it takes 30 to 120 s
Answer = Callable[[str], str]


def led(arguments: list[str], answer: Answer) -> tuple[int, str]:
    """Run `fieldcal` with these arguments. `answer` gets what was printed since the last prompt.

    Returns the exit status and all output.
    """
    with subprocess.Popen(
        [sys.executable, "-m", "agent", *arguments],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=dict(os.environ),
    ) as process:  # fmt: skip
        try:
            return _answered(process, answer)
        finally:
            process.kill()


def _answered(process: subprocess.Popen[bytes], answer: Answer) -> tuple[int, str]:
    assert process.stdin is not None
    assert process.stdout is not None
    told, seen, end_s = "", 0, time.monotonic() + SESSION_S
    with selectors.DefaultSelector() as waiting:
        waiting.register(process.stdout, selectors.EVENT_READ)
        while time.monotonic() < end_s:
            if not waiting.select(1.0):
                continue
            data = process.stdout.read1(65536)  # type: ignore[attr-defined]
            if not data:
                return process.wait(60), told
            told += data.decode()
            if told.endswith("> "):
                process.stdin.write(f"{answer(told[seen:])}\n".encode())
                process.stdin.flush()
                seen = len(told)
    raise AssertionError(f"the session did not end within {SESSION_S:g} s:\n{told}")
