"""A laboratory sits at Windows or macOS: what works on files needs nothing that only Linux has."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from agent.cli.main import COMMANDS, EVERYWHERE, run_cli
from agent.delivery.store import Store
from tests.scenarios.processes import ROOT

GOLDEN = ROOT / "tests" / "replay" / "golden"


@pytest.mark.thorough
def test_files_are_worked_on_everywhere(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the figures need the extra `report`")
    example, data = tmp_path / "example", tmp_path / "data"
    assert run_cli(["simulate", "--preset", "plain", "--csv", str(example), "--duration", "42"]) == 0
    shutil.copytree(sorted(GOLDEN.glob("format-*"))[-1], data)
    (recording,) = data.glob("*.mcap")
    Store(data).close()  # brings the store of an older version up to date, as `fieldcal run` does
    sensor = str(example / "sensor.csv")
    stated = ["--stated", str(ROOT / "examples" / "certificate.toml")]
    commands = [
        ["calibrate", "--sensor", sensor, "--reference", str(example / "reference.csv"),
         "--poses", str(example / "poses.csv"), "--json", str(tmp_path / "result.json")],
        ["certificate", str(tmp_path / "result.json"), *stated, "-o", str(tmp_path / "certificate")],
        ["convert", sensor, "-o", str(tmp_path / "out.csv")],
        ["replay", str(recording)],
        ["audit", str(recording)],
        ["show", "--data-dir", str(data)],
        # The report loads all of its modules before it misses the file.
        ["report", str(tmp_path / "none.json"), "-o", str(tmp_path / "report")],
    ]  # fmt: skip
    assert {command[0] for command in commands} == set(EVERYWHERE)
    done = subprocess.run(
        [sys.executable, "-m", "tests.unit.other_system", json.dumps(commands)],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    # 4: an engine with other results made the recording; it was read to its end, and no check failed.
    statuses = dict(zip([command[0] for command in commands], json.loads(done.stdout.splitlines()[-1]), strict=True))
    assert [statuses[name] for name in ("replay", "audit")] == [4, 4], done.stderr
    made = ("calibrate", "certificate", "convert", "show")
    assert [statuses[name] for name in (*made, "report")] == [0, 0, 0, 0, 2], done.stderr
    assert done.stderr.count("internal fault") == 0
    assert json.loads((tmp_path / "result.json").read_text())["status"] == "valid"


def test_what_needs_linux_says_so_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    for command in set(COMMANDS) - set(EVERYWHERE):
        assert run_cli([command]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"Error: {command} needs Linux; calibrate, ")
