"""`fieldcal bench` as a person uses it, led by a script, on the virtual bench behind real drivers and ports."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from hw.virtual.bench import Bench
from hw.virtual.presets import by_hand
from tests.scenarios.guided import led
from tests.scenarios.processes import fieldcal


def _errors_over_u(output: Path, kind: str, seed: int) -> np.ndarray:
    """Errors of S, row by row, over the expanded uncertainty."""
    found = json.loads((output / "result.json").read_text())
    truth = Bench(by_hand(kind, seed), seed).truth.sensitivity  # type: ignore[arg-type]
    return (np.array(found["sensitivity"]) - truth) / np.array(found["expanded_uncertainty"]["sensitivity"])


@pytest.mark.thorough
def test_a_clamp_with_a_wrong_turn(tmp_path):
    """The wrong turn is noticed with its name; turned right, the session ends where it was wanted, and S is right."""
    wrong = iter(["", "hand 35 60"])

    def answer(_: str) -> str:
        return next(wrong, "")

    status, told = led(
        ["bench", "-o", str(tmp_path / "out"), "--u-main-pct", "0.5", "--u-transverse-pct", "1", "--stay-s", "4",
         "--seed", "3"],
        answer,
    )  # fmt: skip
    assert status == 0, told
    assert told.count("does not look like") == 1
    assert "stands as at 35 60" in told
    assert re.search(r"reached after [3-5] stops", told)
    assert np.abs(_errors_over_u(tmp_path / "out", "clamp", 3)).max() < 1.5
    command = (
        next(line for line in told.splitlines() if "made by: fieldcal calibrate" in line).split("fieldcal ")[1].split()
    )
    before = (tmp_path / "out" / "result.json").read_bytes()
    assert fieldcal(*command).returncode == 0
    assert (tmp_path / "out" / "result.json").read_bytes() == before


@pytest.mark.nightly
def test_a_stop_is_taken_back_and_a_session_ended_early(tmp_path):
    """A position is named by the person, one is taken back, a wrong name is told; the files hold what was kept."""
    answers = iter(["", "u", "no position", "-x", "q"])
    arguments = ["bench", "-o", str(tmp_path / "out"), "--virtual", "gravity", "--stay-s", "2"]
    status, told = led(arguments, lambda _: next(answers, "q"))
    assert status == 3, told  # one rest of two seconds is no calibration
    assert re.search(r"stop 1 \([+-][xyz]\) is not used", told)
    assert "'no position' is no position" in told
    assert "stop 1, -x: U is now" in told
    poses = (tmp_path / "out" / "poses.csv").read_text().splitlines()
    assert len(poses) == 2
    assert [float(field) for field in poses[1].split(",")[2:]] == pytest.approx([-9.80665, 0.0, 0.0])


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--thetas", "35,x"], "must be angles in degrees"),
        (["--u-main-pct", "nan"], "nan"),
    ],
)
def test_bad_input_is_one_line(tmp_path, arguments, said):
    found = fieldcal("bench", "-o", tmp_path / "out", *arguments)
    assert found.returncode == 2
    assert said in found.stderr
    assert "Traceback" not in found.stderr
