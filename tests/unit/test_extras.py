"""`fieldcal extras`: every optional part is listed and can be installed from a directory of wheels, without network."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from agent.cli.main import run_cli
from agent.setup import extras as parts
from tests.scenarios.processes import ROOT

OF_THE_WORK = {"dev", "bench", "build"}  # serve the work on fieldcal itself


def test_every_optional_part_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert run_cli(["extras", "--json", "-"]) == 0
    listed = {part["name"]: part for part in json.loads(capsys.readouterr().out)["extras"]}
    assert set(listed) == set(stated) - OF_THE_WORK
    for name, part in listed.items():
        assert len(part["requirements"]) == len(stated[name])
        assert part["installed"] == (not part["missing"])
    assert run_cli(["extras"]) == 0
    assert capsys.readouterr().out.count("installed  ") == len(listed)


def test_a_part_that_does_not_exist(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["extras", "--install", "reports"]) == 2
    assert "no part 'reports'; the parts are report, files" in capsys.readouterr().err


def test_wheels_beside_it_are_enough(tmp_path: Path) -> None:
    """A wheel made here is installed by the command, into a directory of its own and without any index."""
    wheel = tmp_path / "fieldcal_test_part-1.0-py3-none-any.whl"
    information = "fieldcal_test_part-1.0.dist-info"
    with zipfile.ZipFile(wheel, "w") as file:
        file.writestr("fieldcal_test_part.py", "")
        file.writestr(f"{information}/METADATA", "Metadata-Version: 2.1\nName: fieldcal-test-part\nVersion: 1.0\n")
        file.writestr(f"{information}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        file.writestr(f"{information}/RECORD", "")
    part = parts.Extra("test", "", ("fieldcal-test-part<2,>=1",), ("fieldcal-test-part",))
    command = parts.install_command([part], tmp_path)
    assert command is not None
    assert command[:3] == [sys.executable, "-m", "pip"]
    if find_spec("pip") is None:
        pytest.skip("this Python has no pip")
    target = tmp_path / "installed"
    done = subprocess.run([*command, "--target", target], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (target / "fieldcal_test_part.py").exists()
