"""Every command names the data directory of an agent with --data-dir, and lines of results do not wrap."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from agent.cli.main import run_cli
from tests.replay.golden_files import PRESENT

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("command", "more", "needs"),
    [
        ("audit", [], "FILE.mcap"),
        ("report", ["-o", "out"], "INPUT"),
        ("certificate", ["-o", "out"], "INPUT"),
        ("recall", ["--reference", "s", "--new", "c.toml", "-o", "out"], "PATH"),
    ],
)
def test_what_takes_files_takes_a_data_directory_by_its_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, more: list[str], needs: str
) -> None:
    def said(*arguments: str) -> str:
        assert run_cli([command, *arguments, *more]) == 2
        return capsys.readouterr().err

    assert f"nothing is given; name {needs}, or a data directory with --data-dir D" in said()
    both = said("a.mcap", "--data-dir", str(tmp_path))
    assert f"give {needs} or --data-dir {tmp_path}, not both: remove a.mcap" in both
    assert "does not exist" in said("--data-dir", str(tmp_path / "gone"))
    one, other = said(str(tmp_path)), said("--data-dir", str(tmp_path))  # empty: refused in the same words
    assert one == other
    assert len(one.splitlines()) == 1


@pytest.mark.slow
def test_the_option_and_the_directory_audit_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    one, other = ((run_cli(["audit", *given]), capsys.readouterr().out)
                  for given in ([str(PRESENT)], ["--data-dir", str(PRESENT)]))  # fmt: skip
    assert one == other
    assert "fieldcal-000001.mcap" in one[1]
    assert run_cli(["engines", "list", "--data-dir", str(PRESENT)]) == 0


@pytest.mark.thorough
def test_replay_keeps_a_value_and_its_uncertainty_on_one_line() -> None:
    command = [sys.executable, "-c", "import sys; from agent.cli.main import run_cli; sys.exit(run_cli(sys.argv[1:]))"]
    run = subprocess.run(
        [*command, "replay", *map(str, PRESENT.glob("*.mcap"))], cwd=ROOT, capture_output=True, text=True,
        env=os.environ | {"COLUMNS": "40"}, check=False,
    )  # fmt: skip
    head, *rows = [line for line in run.stdout.splitlines() if line.startswith("  sensor") or "±" in line]
    assert head.split()[:9] == ["sensor", "result", "windows", "Sxx", "Syy", "Szz", "Qx", "Qy", "Qz"]
    assert len(rows) > 1
    for row in rows:
        # Both are rounded to the same place: 0.9887 ± 0.0086.
        assert re.fullmatch(r" +imu +\d+ +\d+" + r" +-?\d+\.(\d+) ± \d+\.\d+" * 6 + r" +1 +m/s²", row), row
        assert all(len(value) == len(U) for value, U in re.findall(r"\d\.(\d+) ± \d+\.(\d+)", row))
