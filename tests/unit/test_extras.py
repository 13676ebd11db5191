"""`fieldcal extras`: every optional part is listed and can be installed from a directory of wheels, without network."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from agent.cli.main import run_cli
from agent.setup import extras as parts
from tests.scenarios.processes import ROOT


def test_every_optional_part_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert run_cli(["extras", "--json", "-"]) == 0
    listed = {part["name"]: part for part in json.loads(capsys.readouterr().out)["extras"]}
    assert set(listed) == set(stated)
    for name, part in listed.items():
        assert len(part["requirements"]) == len(stated[name])
        assert part["installed"] == (not part["missing"])
    assert run_cli(["extras"]) == 0
    assert capsys.readouterr().out.count("installed  ") == len(listed)


def test_a_part_that_does_not_exist(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["extras", "--install", "reports"]) == 2
    assert "no part 'reports'; the parts are report, files" in capsys.readouterr().err


def test_what_pip_says_is_told_where_it_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fails = [sys.executable, "-S", "-c", "print('no matching distribution'); raise SystemExit(1)"]
    monkeypatch.setattr("agent.cli.extras.install_command", lambda *_: fails)
    assert run_cli(["extras", "--install", "report", "--index"]) == 1
    assert capsys.readouterr().err.splitlines()[1:] == [
        "no matching distribution", "fieldcal extras: pip could not install this from the package index",
    ]  # fmt: skip


@pytest.mark.parametrize("name", parts.PURPOSES)
def test_each_part_is_locked_with_what_it_needs(name: str) -> None:
    """Each requirement has a version with a hash that fits, and nothing of the gateway's own lock is there again."""
    (part,) = (part for part in parts.extras() if part.name == name)
    locked = locked_in(Path(part.lock))
    for text in part.requirements:
        requirement = Requirement(text)
        assert requirement.specifier.contains(locked[requirement.name.lower()]), text
    assert Path(part.lock).read_text().count("--hash=sha256:") >= len(locked)
    assert not set(locked) & set(locked_in(ROOT / "requirements.lock"))


def test_parts_are_locked_to_the_versions_that_are_tested() -> None:
    tested = locked_in(ROOT / "requirements-dev.lock")
    for lock in parts.LOCKS.iterdir():
        both = {name: version for name, version in locked_in(lock).items() if name in tested}
        assert both == {name: tested[name] for name in both}, lock.name


def test_a_gateway_installs_no_build_tool() -> None:
    build = locked_in(ROOT / "requirements-build.lock")
    assert {"hatchling", "editables"} <= set(build)
    assert not set(build) & set(locked_in(ROOT / "requirements.lock"))


def locked_in(lock: Path) -> dict[str, str]:
    """Name: version of each package in a lock file."""
    return dict(re.findall(r"^([\w.-]+?)(?:\[[\w,]+\])?==([^ ]+)", lock.read_text(), re.MULTILINE))


@pytest.fixture
def part(tmp_path: Path) -> parts.Extra:
    """A part of one wheel, made here, in `tmp_path/wheels`, and its lock file."""
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    wheel = wheels / "fieldcal_test_part-1.0-py3-none-any.whl"
    information = "fieldcal_test_part-1.0.dist-info"
    with zipfile.ZipFile(wheel, "w") as file:
        file.writestr("fieldcal_test_part.py", "")
        file.writestr(f"{information}/METADATA", "Metadata-Version: 2.1\nName: fieldcal-test-part\nVersion: 1.0\n")
        file.writestr(f"{information}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        file.writestr(f"{information}/RECORD", "")
    lock = tmp_path / "test.lock"
    lock.write_text(f"fieldcal-test-part==1.0 --hash=sha256:{hashlib.sha256(wheel.read_bytes()).hexdigest()}\n")
    return parts.Extra("test", "", ("fieldcal-test-part<2,>=1",), ("fieldcal-test-part",), str(lock))


def install(part: parts.Extra, directory: Path) -> subprocess.CompletedProcess[str]:
    command = parts.install_command([part], directory / "wheels")
    assert command is not None
    assert command[:3] == [sys.executable, "-m", "pip"]
    if find_spec("pip") is None:
        pytest.skip("this Python has no pip")
    return subprocess.run([*command, "--target", directory / "installed"], capture_output=True, text=True, check=False)


@pytest.mark.thorough
def test_wheels_beside_it_are_enough(part: parts.Extra, tmp_path: Path) -> None:
    """The command installs the wheel, into a directory of its own and without any index."""
    done = install(part, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "installed/fieldcal_test_part.py").exists()


@pytest.mark.slow
def test_a_wheel_with_another_content_is_refused(part: parts.Extra, tmp_path: Path) -> None:
    (wheel,) = (tmp_path / "wheels").iterdir()
    with zipfile.ZipFile(wheel, "a") as file:
        file.writestr("fieldcal_test_part_more.py", "")
    done = install(part, tmp_path)
    assert done.returncode != 0
    assert "HASHES" in done.stderr
    assert not (tmp_path / "installed").exists()
