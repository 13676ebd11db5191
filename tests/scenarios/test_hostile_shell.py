"""Commands whose input is not a regular file, or whose output cannot be written, end with one line and a status."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agent.delivery.history import StoredResult
from agent.delivery.store import Store
from tests.scenarios.processes import ROOT, fieldcal, interrupt, started, wait_until
from tests.unit.results import calibration, status


@pytest.mark.one_case
@pytest.mark.parametrize("command", ["replay", "audit"])
def test_a_recording_that_is_no_file_is_bad_input(tmp_path: Path, command: str) -> None:
    pipe = tmp_path / "pipe.mcap"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/zero"), tmp_path):
        told = fieldcal(command, path)
        assert told.returncode == 2
        assert told.stderr.count("\n") == 1
        assert str(path) in told.stderr


def test_a_configuration_without_end_is_bad_input() -> None:
    told = fieldcal("check", "/dev/zero")
    assert (told.returncode, told.stderr.count("\n")) == (2, 1)


def filled(data_dir: Path) -> Path:
    store = Store(data_dir, 0)
    store.commit([StoredResult.of(r, recorded=True, recording="") for r in (calibration(1), status(2))])
    store.close()
    return data_dir


def test_an_output_that_takes_nothing_is_one_line(tmp_path: Path) -> None:
    command: list[str | Path] = [sys.executable, "-m", "agent", "show", "--data-dir", filled(tmp_path)]
    with open("/dev/full", "w") as full:
        told = subprocess.run(
            command, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False
        )
    assert (told.returncode, told.stderr) == (1, "fieldcal: [Errno 28] No space left on device\n")


@pytest.mark.thorough
def test_an_output_without_unicode_gets_what_it_can_take(tmp_path: Path) -> None:
    command: list[str | Path] = [sys.executable, "-m", "agent", "show", "--data-dir", filled(tmp_path)]
    ascii_only = os.environ | {"PYTHONIOENCODING": "ascii"}
    told = subprocess.run(command, cwd=ROOT, env=ascii_only, capture_output=True, text=True, timeout=60, check=False)
    assert told.returncode == 0, told.stderr
    assert "26154 ? 12" in told.stdout


def rests(tmp_path: Path) -> Path:
    """A file of a sensor at rest in 14 positions, with names of columns that must be guessed."""
    random = np.random.default_rng(5)
    towards = random.normal(size=(14, 3))
    V = np.repeat(9.8 * towards / np.linalg.norm(towards, axis=1)[:, None], 400, axis=0)
    V += random.normal(0, 0.002, V.shape)
    path = tmp_path / "rests.csv"
    np.savetxt(path, np.column_stack([np.arange(len(V)) / 100, V]), "%.5f", ",", header="Time,X,Y,Z", comments="")
    return path


def test_calibrate_on_control_c_ends_with_130(tmp_path: Path) -> None:
    pipe, output = tmp_path / "result.json", tmp_path / "output"
    os.mkfifo(pipe)  # nobody reads it, so the command cannot end by itself
    with started("calibrate", "--sensor", rests(tmp_path), "--json", pipe, output=output) as process:
        wait_until(lambda: "guessed" in output.read_text(), 60, "the file is read")
        interrupt(process)
    assert process.returncode == 130
    assert output.read_text().splitlines()[-1] == "interrupted"
    assert "Traceback" not in output.read_text()


@pytest.mark.thorough
def test_json_goes_to_a_file(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    told = fieldcal("calibrate", "--sensor", rests(tmp_path), "--json", path)
    assert (told.returncode, json.loads(path.read_text())["status"]) == (0, "valid")
    assert "Sx" in told.stdout  # the table
    refused = fieldcal("calibrate", "--sensor", rests(tmp_path), "--json", tmp_path / "nowhere" / "result.json")
    assert refused.returncode == 2
    assert f"{tmp_path}/nowhere/result.json" in refused.stderr
    assert "Traceback" not in refused.stderr
