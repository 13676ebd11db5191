"""A program that reads the output, such as `head`, may end before fieldcal does."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("command", ["sensors", "--help", "run --help"])
def test_a_reader_that_has_ended_is_no_fault(command: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        ended = subprocess.run(
            [sys.executable, "-m", "agent", *command.split()], stdout=writing, stderr=subprocess.PIPE, timeout=60
        )
    finally:
        os.close(writing)
    assert (ended.returncode, ended.stderr) == (1, b"")


def test_neither_where_the_output_is_a_table(tmp_path: Path) -> None:
    """`calibrate` prints by rich, which has its own way to end a program."""
    (tmp_path / "a.csv").write_text("time_s,vx,vy,vz\n" + "".join(f"{k / 100},0,0,9.8\n" for k in range(1000)))
    test_a_reader_that_has_ended_is_no_fault(f"calibrate --sensor {tmp_path / 'a.csv'}")
