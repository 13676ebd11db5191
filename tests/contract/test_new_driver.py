"""`fieldcal new-driver`: what it writes passes the contract of all drivers, and names its entry point."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from agent.cli.main import run_cli
from tests.scenarios.processes import ROOT


@pytest.mark.slow
def test_its_own_tests_pass(tmp_path: Path) -> None:
    package = tmp_path / "my-imu"
    assert run_cli(["new-driver", "my-imu", "--output", str(package)]) == 0
    assert "@" not in "".join(path.read_text() for path in package.iterdir()).replace("@pytest", "")
    project = tomllib.loads((package / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["fieldcal.sensors"] == {"my-imu": "fieldcal_my_imu:MyImu"}
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "PYTHONDONTWRITEBYTECODE": "1",
        "FIELDCAL_CONTRACT_SAMPLES": "2000",
    }
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(package), str(package)]
    done = subprocess.run(command, cwd=package, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(re.findall(r"(\d+) passed", done.stdout)[0]) == 17


@pytest.mark.parametrize("name", ["My", "my--imu", "../my", "adxl355", ""])
def test_names_that_cannot_be_used(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["new-driver", name, "--output", str(tmp_path / "new")]) == 2
    assert capsys.readouterr().err.startswith("fieldcal new-driver: ")
    assert not (tmp_path / "new").exists()


def test_an_existing_directory_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["new-driver", "my-imu", "--output", str(tmp_path)]) == 2
    assert "it exists" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
