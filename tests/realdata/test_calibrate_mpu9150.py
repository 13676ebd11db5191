"""Two MPU-9150 from their raw logs as a user would hand them in: rests found by the tool, gravity all that is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from tests.realdata.datasets import dataset
from tests.realdata.test_mpu9150 import GRAVITY_MPS2, LIMIT_Q_MPS2, LIMIT_S, PUBLISHED, RATE_HZ, _expected


@pytest.mark.parametrize("sensor", PUBLISHED)
def test_raw_log_gives_the_published_table(sensor: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = np.loadtxt(dataset("mikoff_mpu9150") / f"{sensor}.log")[:, :3]
    rows = np.column_stack([np.arange(len(log)) / RATE_HZ, log])
    path = tmp_path / "sensor.csv"
    np.savetxt(path, rows, fmt="%.6f", delimiter=",", header="time_s,vx,vy,vz", comments="")
    assert run_cli(["calibrate", "--sensor", str(path), "--gravity", f"{GRAVITY_MPS2}", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    S, Q = _expected(sensor)
    np.testing.assert_allclose(found["sensitivity"], S, rtol=0, atol=LIMIT_S)
    np.testing.assert_allclose(found["offset"], Q, rtol=0, atol=LIMIT_Q_MPS2)
    assert found["frame"] == "free"
    assert len(found["windows"]) >= 20
