"""`fieldcal run` with a broker that is away at the start, stops, and comes back; and a run that is killed."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest

from tests.scenarios.processes import started
from tests.unit.broker import Broker, Subscriber, needs_mosquitto
from tests.unit.zenoh_site import wait_for

pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed (extra mqtt)")
TOP = "fieldcal/v1/workshop/gw-1"
CONFIG = """
[gateway]
site = "workshop"
name = "gw-1"
[[devices]]
name = "mems"
driver = "virtual"
options = {{ role = "sensor" }}
[[devices]]
name = "reference"
driver = "virtual"
options = {{ role = "reference" }}
[[channels]]
sensor = "mems"
reference = "reference"
[channels.prior]
[zenoh]
enabled = false
[supervision]
status_s = 1
[mqtt]
enabled = true
port = {port}
"""


@needs_mosquitto
def test_a_broker_that_stops_delays_nothing_and_a_killed_gateway_is_off(tmp_path: Path) -> None:
    broker, config = Broker(tmp_path), tmp_path / "gateway.toml"
    config.write_text(CONFIG.format(port=broker.port))
    with started("run", config, "--data-dir", tmp_path / "data", "--log", "json", output=tmp_path / "output") as agent:
        wait_for(lambda: "Connection refused" in (tmp_path / "output").read_text(), 60)
        broker.start()
        watching = Subscriber(broker)

        def statuses() -> list[dict[str, Any]]:
            return [json.loads(value) for value in watching.of(f"{TOP}/status")]

        wait_for(lambda: bool(statuses()) and statuses()[-1]["mqtt"]["connected"], 60)
        assert json.loads(watching.of(f"{TOP}/mems/status")[-1])["status"] == "UNCALIBRATED"
        before = statuses()[-1]["uptime_s"]
        assert broker.process is not None
        os.kill(broker.process.pid, signal.SIGSTOP)
        recording = next((tmp_path / "data").glob("*.mcap.active"))
        size = recording.stat().st_size
        wait_for(lambda: recording.stat().st_size > size + 20_000, 60)  # some seconds of two devices
        os.kill(broker.process.pid, signal.SIGCONT)
        wait_for(lambda: statuses()[-1]["uptime_s"] > before + 2, 60)
        newest = statuses()[-1]
        assert [device["gaps"] for device in newest["devices"].values()] == [0, 0]
        assert all(queue["waiting"] < queue["capacity"] / 10 for queue in newest["queues"].values())
        agent.kill()
        wait_for(lambda: watching.of(f"{TOP}/alive")[-1] == b"offline")  # its last will
    watching.close()
    broker.kill()
