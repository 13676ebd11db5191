"""The six-position session as a user would hand it in: CSV with poses in seconds, gravity as the excitation."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from tests.realdata.datasets import dataset

RATE_HZ = 204.8
GRAVITY_MPS2 = 9.81
UP = {f"{axis}_{way}": sign * np.eye(3)[i] for i, axis in enumerate("xyz") for way, sign in (("p", 1.0), ("a", -1.0))}


def as_files(directory: Path) -> None:
    with (dataset("imucal_ferraris") / "annotated_session.csv").open() as file:
        rows = sorted(csv.DictReader(file), key=lambda row: int(row["samples"]))
    first = int(rows[0]["samples"])
    times = [(int(row["samples"]) - first) / RATE_HZ for row in rows]
    lines = [f"{t:.6f},{r['acc_x']},{r['acc_y']},{r['acc_z']}" for t, r in zip(times, rows, strict=True)]
    (directory / "sensor.csv").write_text("\n".join(["time_s,vx,vy,vz", *lines]) + "\n")
    poses = ["start_s,stop_s,gx,gy,gz"]
    for part, up in UP.items():
        inside = [t for t, row in zip(times, rows, strict=True) if row["part"] == part]
        poses.append(f"{inside[0]:.6f},{inside[-1]:.6f}," + ",".join(f"{GRAVITY_MPS2 * x:g}" for x in up))
    (directory / "poses.csv").write_text("\n".join(poses) + "\n")


def test_six_positions_from_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    as_files(tmp_path)
    args = ["--sensor", str(tmp_path / "sensor.csv"), "--poses", str(tmp_path / "poses.csv")]
    assert run_cli(["calibrate", *args, "--plain", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    stored = json.loads((dataset("imucal_ferraris") / "example_cal.json").read_text())
    S = np.array(stored["K_a"]) @ np.array(stored["R_a"])
    # imucal weighs positions alike, least squares over all points by their number: that alone makes 0.07 %.
    assert np.abs((np.array(found["sensitivity"]) - S) / np.diag(S)[:, None]).max() < 1e-3
    assert found["rate_hz"] == pytest.approx(RATE_HZ, rel=1e-6)
    assert [w["used"] for w in found["windows"]] == [True] * 6
    assert all(w["points"] > 500 for w in found["windows"])
