"""A person turning a real sensor, played over a serial port into the live agent: against the result imucal stored."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from agent.delivery.router import open_router
from tests.realdata.datasets import dataset
from tests.realdata.test_calibrate_imucal import as_files
from tests.scenarios.processes import fieldcal, interrupt, recordings, results, started, wait_until

WITHIN = 1e-3  # of the row's main sensitivity: guards leave out 0.2 s of each rest, imucal takes all of it
NOMINAL = 208.0  # counts per m/s2, as a data sheet of 2048 per g rounds it
CONFIG = """
[gateway]
site = "test"
name = "recorded"
[[devices]]
name = "imu"
driver = "serial-csv"
options = {{ port = "{port}", rate_hz = 204.8, axes = 3, sequence = true, unit = "count" }}
[[channels]]
sensor = "imu"
prior = {{ sensitivity = {nominal}, u_main_pct = 20 }}
guard_s = 0.2
poses = [
{poses}
]
[zenoh]
connect = ["{endpoint}"]
"""
KEY = "fieldcal/v1/test/recorded/imu/calibration"


@pytest.fixture
def router() -> Iterator[str]:
    """The endpoint of a router that is there for the test alone."""
    session, endpoints = open_router("tcp/127.0.0.1:0")
    yield endpoints[0]
    session.close()


def published(endpoint: str) -> list[dict[str, Any]]:
    """What a plain client gets now."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    with zenoh.open(config) as session:
        return [json.loads(reply.ok.payload.to_string()) for reply in session.get(KEY) if reply.ok is not None]


@pytest.mark.slow
def test_played_over_a_port_the_agent_finds_what_imucal_found(tmp_path: Path, router: str) -> None:
    as_files(tmp_path)
    rests = np.loadtxt(tmp_path / "poses.csv", delimiter=",", skiprows=1)
    rests = rests[np.argsort(rests[:, 0])]
    stored = json.loads((dataset("imucal_ferraris") / "example_cal.json").read_text())
    expected = np.array(stored["K_a"]) @ np.array(stored["R_a"])
    port, data_dir, config = tmp_path / "port", tmp_path / "data", tmp_path / "config.toml"
    poses = "\n".join(
        f"  {{ start_s = {start:.6f}, stop_s = {stop:.6f}, gravity_mps2 = {gravity} }},"
        for start, stop, *gravity in rests.tolist()
    )
    config.write_text(CONFIG.format(port=port, poses=poses, endpoint=router, nominal=NOMINAL))
    playing = ("simulate", "--play", tmp_path / "sensor.csv", "--sequence", "--link", port)
    with started(*playing, output=tmp_path / "playing"):
        wait_until(port.is_symlink, 60, "the port")
        with started("run", config, "--data-dir", data_dir, output=tmp_path / "output") as agent:
            # The last rest ends after 27.3 s; what follows is turning.
            wait_until(lambda: len(results(data_dir, "window")) >= len(rests), 60, "six windows")
            wait_until(lambda: results(data_dir, "calibration")[-1]["windows"] == len(rests), 60, "from all of them")
            in_force = results(data_dir, "calibration")[-1]
            wait_until(lambda: published(router) == [in_force], 60, "a plain client gets it")
            interrupt(agent)
    difference = np.abs(np.array(in_force["sensitivity"]) - expected) / np.diag(expected)[:, None]
    assert difference.max() < WITHIN, difference
    assert "Traceback" not in (tmp_path / "output").read_text()
    told = json.loads(fieldcal("replay", *recordings(data_dir), "--json", "-").stdout)
    assert told["equal"] is True
    assert told["calibrations"][-1]["sensitivity"] == in_force["sensitivity"]
