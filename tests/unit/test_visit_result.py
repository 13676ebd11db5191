"""A visit whose samples `fieldcal calibrate` does not take has no result, and says so; other sensors are visited."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.bench.kinds import mounted_stop
from agent.bench.measuring import StopInterval
from agent.bench.visit_dialogue import Visited
from agent.cli.visit import _result
from agent.config import parse_config

DEVICES = [
    {"name": name, "driver": "serial-csv", "options": {"port": name, "rate_hz": 50.0, "axes": 3}} for name in "sr"
]
BESIDE = {"sensor": "s", "reference": "r", "rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1]}
PRIOR = {"sensitivity": [1, 0, 0, 0, 1, 0, 0, 0, 1], "u_main_pct": 3.0, "u_transverse_pct": 1.0}
CHANNEL = parse_config({"devices": DEVICES, "channels": [BESIDE | {"prior": PRIOR}]}, "").channels[0]


def test_samples_that_calibrate_does_not_take_are_a_sensor_without_a_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "s").mkdir()
    for name in ("sensor", "reference", "poses"):
        (tmp_path / "s" / f"{name}.csv").write_text("time_s,x,y,z\n0.0,1,1,1\n0.0,broken,1,1\n")
    arguments = [f"--{name}={tmp_path / 's' / name}.csv" for name in ("sensor", "reference", "poses")]
    arguments.append(f"--json={tmp_path / 's' / 'result.json'}")
    told: list[str] = []
    visited = Visited("measured", StopInterval(mounted_stop(CHANNEL), 0.0, 60.0))
    options = {"data_dir": tmp_path, "apart": True, "stated": None}
    result = _result(CHANNEL, visited, arguments, options, told.append)
    assert result["status"] == "refused"
    assert result["reasons"] == [f"fieldcal calibrate does not take the samples in {tmp_path / 's'}"]
    assert "broken" in capsys.readouterr().err
