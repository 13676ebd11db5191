"""The real agent under a substitute of systemd: ready, watchdog fed only by blocks, degraded and running, stopping."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest
import zenoh

from hw.virtual.serial_port import PtyDevice, SampleLines
from tests.scenarios.processes import ROOT, wait_until
from tests.unit.zenoh_site import Site

WATCHDOG_S = 2.0
CONFIG = """
[gateway]
site = "site"
name = "gw"
[[devices]]
name = "imu"
driver = "serial-csv"
options = {{ port = "{port}", rate_hz = 100, axes = 3, sequence = true, unit = "m/s2" }}
[[channels]]
sensor = "imu"
prior = {{}}
[zenoh]
connect = ["{endpoint}"]
"""


class Systemd:
    """Receives notifications, each with its time of arrival."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.setblocking(False)
        self.environment = {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": str(int(WATCHDOG_S * 1e6))}
        self.told: list[tuple[float, str]] = []

    def has(self, message: str, since_s: float = 0.0) -> bool:
        """Whether a notification that begins with `message` has come since `since_s`."""
        while True:
            try:
                self.told.append((time.monotonic(), self._socket.recv(4096).decode()))
            except BlockingIOError:
                return any(t >= since_s and m.startswith(message) for t, m in self.told)

    def fed_within(self, duration_s: float) -> bool:
        """Whether the watchdog is fed at least once in the next `duration_s` seconds."""
        since_s = time.monotonic()
        while time.monotonic() < since_s + duration_s:
            if self.has("WATCHDOG=1", since_s):
                return True
            time.sleep(0.02)  # polls
        return False

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[Systemd]:
    systemd = Systemd(tmp_path / "notify")
    yield systemd
    systemd.close()


@pytest.fixture
def imu(tmp_path: Path) -> Iterator[PtyDevice]:
    # The time since the machine was started would make a line for every sample since then.
    began_s = time.monotonic()
    lines = SampleLines(lambda _, n: np.ones((n, 3)), lambda t_s: int((t_s - began_s) * 100))
    device = PtyDevice(lines, link=tmp_path / "imu")
    device.start()
    yield device
    device.stop()


@pytest.fixture
def agent(tmp_path: Path, imu: PtyDevice, site: Site, systemd: Systemd) -> Iterator[subprocess.Popen[bytes]]:
    config = tmp_path / "gateway.toml"
    config.write_text(CONFIG.format(port=imu.path, endpoint=site.endpoint))
    command: list[str | Path] = [sys.executable, "-m", "agent", "run", config, "--data-dir", tmp_path / "data"]
    with open(tmp_path / "log", "wb") as log:
        there = os.fstat(log.fileno())
        environment = os.environ | systemd.environment | {"JOURNAL_STREAM": f"{there.st_dev}:{there.st_ino}"}
        process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=log)
    yield process
    process.kill()
    process.wait()


def test_it_tells_how_it_is_from_beginning_to_end(
    tmp_path: Path, imu: PtyDevice, site: Site, systemd: Systemd, agent: subprocess.Popen[bytes]
) -> None:
    with site.client() as client:
        subscriber = client.declare_subscriber("fieldcal/v1/site/gw/status", zenoh.handlers.RingChannel(100))
        wait_until(lambda: systemd.has("READY=1"), 60, "ready")
        wait_until(lambda: systemd.has("STATUS=running; imu "), 60, "a status with the rate")
        wait_until(lambda: systemd.fed_within(WATCHDOG_S / 2), 60, "fed")
        imu.unplug()
        wait_until(lambda: systemd.has("STATUS=degraded: imu is lost"), 60, "degraded")
        assert not systemd.fed_within(2 * WATCHDOG_S), "nothing flows"
        imu.replug()
        plugged_s = time.monotonic()
        wait_until(lambda: systemd.has("STATUS=running", plugged_s), 60, "running again")
        wait_until(lambda: systemd.fed_within(WATCHDOG_S / 2), 60, "fed again")
        agent.terminate()
        assert agent.wait(60) == 0
        assert systemd.has("STOPPING=1")
        states = []
        while (sample := subscriber.try_recv()) is not None:
            states.append(json.loads(sample.payload.to_string())["state"])
        subscriber.undeclare()
    expected = ["running", "degraded", "running", "stopping"]
    assert [state for state, _ in groupby(states)] == expected
    log = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    assert {entry["level"] for entry in log} == {"info", "warning"}
    # A state is logged again where its reason changes.
    logged = [e["state"] for e in log if e.get("event") == "state"]
    assert [state for state, _ in groupby(logged)] == expected
    first, *between, last = [e["state"] for e in log if e.get("event") == "device"]
    assert (first, set(between), last) == ("open", {"lost"}, "open")


@pytest.mark.thorough
def test_an_agent_that_stands_still_does_not_feed(systemd: Systemd, agent: subprocess.Popen[bytes]) -> None:
    wait_until(lambda: systemd.has("WATCHDOG=1"), 60, "fed")
    agent.send_signal(signal.SIGSTOP)
    systemd.has("")
    assert not systemd.fed_within(1.5 * WATCHDOG_S)
    agent.send_signal(signal.SIGCONT)
    wait_until(lambda: systemd.fed_within(WATCHDOG_S), 60, "fed again")


@pytest.mark.thorough
def test_an_absent_device_does_not_keep_it_from_being_ready(
    imu: PtyDevice, systemd: Systemd, agent: subprocess.Popen[bytes]
) -> None:
    imu.unplug()
    wait_until(lambda: systemd.has("READY=1"), 60, "ready")
    wait_until(lambda: systemd.has("STATUS=degraded: imu is lost"), 60, "it says what is missing")
    assert not systemd.has("WATCHDOG=1")
    agent.terminate()
    assert agent.wait(60) == 0
