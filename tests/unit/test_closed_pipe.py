"""A program that reads the output, such as `head`, may end before fieldcal does."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest


def _ended(*command: str) -> tuple[int, bytes]:
    """Exit status and standard error of a command whose output nobody reads."""
    reading, writing = os.pipe()
    os.close(reading)
    try:
        ended = subprocess.run(
            [sys.executable, "-m", "agent", *command], stdout=writing, stderr=subprocess.PIPE, timeout=60
        )
    finally:
        os.close(writing)
    return ended.returncode, ended.stderr


@pytest.mark.one_case
@pytest.mark.parametrize("command", ["sensors", "--help", "run --help"])
def test_a_reader_that_has_ended_is_no_fault(command: str) -> None:
    assert _ended(*command.split()) == (1, b"")


@pytest.mark.thorough
def test_tables_on_a_terminal_neither(tmp_path: Path) -> None:
    """The tables of a calibration are drawn by another library than the rest of the output."""
    samples = tmp_path / "sensor.csv"
    time_s = np.arange(0.0, 40.0, 0.01)
    ups = np.vstack([np.eye(3), -np.eye(3), np.ones((1, 3)) / np.sqrt(3.0), [[0.6, -0.8, 0.0]]])
    noise = np.random.default_rng(1).normal(0.0, 0.002, (len(time_s), 3))
    values = 9.80665 * ups[np.minimum((time_s // 5.0).astype(int), len(ups) - 1)] + noise
    np.savetxt(
        samples, np.column_stack([time_s, values]), fmt="%.5f", delimiter=",", header="time_s,vx,vy,vz", comments=""
    )
    assert _ended("calibrate", "--sensor", str(samples)) == (1, b"")
