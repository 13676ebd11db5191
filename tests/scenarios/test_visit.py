"""`fieldcal visit` as a person uses it, led by a script, on the virtual structure behind real drivers and ports."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest

from hw.virtual.visits import Structure, StructureParameters
from tests.scenarios.guided import led
from tests.scenarios.processes import fieldcal

SEED = 2


@pytest.mark.thorough
@pytest.mark.slow
def test_two_visits_with_a_turned_and_a_loose_clamp(tmp_path):
    """Each wrong clamp is named; then S of both sensors is right within its U, and one reference's error is shared."""
    answers, last = iter(["turned", "", "loose", ""]), ""

    def answer(told: str) -> str:
        nonlocal last
        if "no samples of" not in told:  # on a busy machine the same is measured anew
            last = next(answers, "q")
        return last

    out, told_json = tmp_path / "out", tmp_path / "all.json"
    status, told = led(
        ["visit", "--data-dir", str(out), "--json", str(told_json), "--seed", str(SEED), "--u-pct", "0.5",
         "--sensor", "sensor-1", "--sensor", "sensor-3"],
        answer,
    )  # fmt: skip
    assert status == 0, told
    first, second = told.split("visit 2 of 2")
    assert "turned by" in first
    assert "about its z axis" in first
    assert "loose" not in first
    assert "the clamp is loose" in second
    assert "turned by" not in second
    assert "without another visit U (main) will be" in first
    assert "U exceeds 1 % " in first
    found = json.loads(told_json.read_text())
    assert [v["sensor"] for v in found["visits"]] == ["sensor-1", "sensor-3"]
    assert len(found["shared_errors"]) >= 1
    truth = Structure(StructureParameters(u_turned_deg=0.2, u_reference=0.001), SEED).sensitivity
    for number, visit in zip((0, 2), found["visits"], strict=True):
        assert (visit["status"], visit["unit"]) == ("valid", "m/s2")
        assert visit["reached"]
        assert visit["clamp"]["findings"] == []
        U = np.array(visit["expanded_uncertainty"]["sensitivity"])
        assert np.diag(U).max() <= 0.0051
        assert np.abs((np.array(visit["sensitivity"]) - truth[number]) / U).max() < 1.5
        after = [a["u_main_pct"] for a in visit["growth"]["after"]]
        assert after == sorted(after)
        assert (out / visit["sensor"] / "result.json").is_file()


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("", "needs reference, with three axes, and rotation"),
        (
            "reference = 'portable'\nrotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]",
            "--sensor nobody: no channel has it; there are north",
        ),
    ],
)
def test_bad_input_is_one_line(tmp_path, change, said):
    text = f"""
[[devices]]
name = "north"
driver = "serial-csv"
options = {{ port = "/dev/null", axes = 3, rate_hz = 200, unit = "m/s2" }}
[[devices]]
name = "portable"
driver = "serial-csv"
options = {{ port = "/dev/zero", axes = 3, rate_hz = 200, unit = "m/s2" }}
[[channels]]
sensor = "north"
{change or "poses = [{ start_s = 0, stop_s = 10, gravity_mps2 = [0, 0, 9.80665] }]"}
prior = {{ sensitivity = 1.0 }}
"""
    tomllib.loads(text)
    (tmp_path / "gateway.toml").write_text(text)
    more = ["--sensor", "nobody"] if change else []
    found = fieldcal("visit", tmp_path / "gateway.toml", "--data-dir", tmp_path / "out", *more)
    assert found.returncode == 2
    assert said in found.stderr
    assert "Traceback" not in found.stderr
    assert not (tmp_path / "out").exists()
