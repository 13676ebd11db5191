"""Commands whose input is not a regular file, or whose output cannot be written, end with one line and a status."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from agent.delivery.history import Record
from agent.delivery.store import Store
from tests.scenarios.processes import ROOT, fieldcal
from tests.unit.results import calibration, status


@pytest.mark.parametrize("command", ["replay", "audit"])
def test_a_recording_that_is_no_file_is_bad_input(tmp_path: Path, command: str) -> None:
    pipe = tmp_path / "pipe.mcap"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/zero"), tmp_path):
        told = fieldcal(command, path, timeout_s=20)
        assert told.returncode == 2
        assert told.stderr.count("\n") == 1
        assert str(path) in told.stderr


def test_a_configuration_without_end_is_bad_input() -> None:
    told = fieldcal("check", "/dev/zero", timeout_s=20)
    assert (told.returncode, told.stderr.count("\n")) == (2, 1)


def filled(data_dir: Path) -> Path:
    store = Store(data_dir, 0)
    store.commit([Record.of(r, recorded=True, recording="") for r in (calibration(1), status(2))])
    store.close()
    return data_dir


def test_an_output_that_takes_nothing_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "agent", "show", "--data-dir", filled(tmp_path)]
    with open("/dev/full", "w") as full:
        told = subprocess.run(
            command, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True, timeout=20, check=False
        )
    assert (told.returncode, told.stderr) == (1, "fieldcal: [Errno 28] No space left on device\n")


def test_an_output_without_unicode_gets_what_it_can_take(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "agent", "show", "--data-dir", filled(tmp_path)]
    ascii_only = os.environ | {"PYTHONIOENCODING": "ascii"}
    told = subprocess.run(command, cwd=ROOT, env=ascii_only, capture_output=True, text=True, timeout=20, check=False)
    assert told.returncode == 0, told.stderr
    assert "26154 ? 12" in told.stdout
