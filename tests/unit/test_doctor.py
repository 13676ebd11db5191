"""`fieldcal doctor`: each fault of a gateway is found, with its remedy, and nothing is found where nothing is wrong."""

from __future__ import annotations

import json
import math
import os
import socket
import struct
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.config import Config, parse_config
from agent.core.events import ClockReport
from agent.delivery.history import StoredResult
from agent.delivery.store import Store
from agent.setup import device_checks, machine_checks
from agent.setup.contradictions import contradictions
from agent.setup.finding import Finding
from hw.adxl355 import Adxl355Options
from hw.block import DeviceInfo, Drop, SampleBlock
from hw.sensor import boot_id

NOW = datetime(2026, 6, 1, tzinfo=UTC)
KEPT = 512 * 1024 * 1024  # bytes, default of recording.least_free_bytes


def gateway(*ports: Path | str, **certificate: Any) -> dict[str, Any]:
    """A sensor, and with two ports a reference beside it."""
    names = ("mems", "reference")[: len(ports)]
    devices = [
        {"name": name, "driver": "serial-csv", "options": {"port": str(port), "rate_hz": 200, "sequence": True}}
        for name, port in zip(names, ports, strict=True)
    ]
    channel: dict[str, Any] = {"sensor": "mems", "prior": {}}
    if len(ports) == 2:
        channel |= {"reference": "reference", "rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "certificate": certificate}
    return {"devices": devices, "channels": [channel]}


def config_of(**certificate: Any) -> Config:
    return parse_config(gateway("/dev/none", "/dev/nothing", **certificate), "test")


def told(findings: Iterator[Finding] | list[Finding], check: str) -> list[tuple[str, str]]:
    return [(finding.verdict, finding.says) for finding in findings if finding.check == check]


def test_a_reference_that_is_overdue_or_will_be() -> None:
    def verdict(**certificate: Any) -> tuple[str, str]:
        (found,) = told(machine_checks.certificate_findings(config_of(**certificate), NOW), "certificate")
        return found

    assert verdict(calibrated="2025-05-01", interval_years=2)[0] == "good"
    state, says = verdict(calibrated="2025-06-20", interval_years=1)
    assert state == "advice"
    assert "in 60 days" in says
    assert verdict(calibrated="2025-05-01", interval_years=1)[0] == "fault"
    assert verdict()[0] == "advice"


def test_a_clock_that_was_set_back(tmp_path: Path) -> None:
    newest = tmp_path / "fieldcal-000001.mcap"
    newest.touch()
    os.utime(newest, (NOW.timestamp() + 3600,) * 2)
    faults = [f for f in machine_checks.clock_findings(tmp_path, NOW) if f.verdict == "fault"]
    assert ["3600 s before the newest recording" in f.says for f in faults] == [True]
    os.utime(newest, (NOW.timestamp() - 3600,) * 2)
    assert all(f.verdict != "fault" for f in machine_checks.clock_findings(tmp_path, NOW))


def test_synchronisation_is_what_the_kernel_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = machine_checks.kernel_clock()
    assert real is None or 0 <= real[1] <= 16_000_000 or real[0] & machine_checks.UNSYNCHRONISED
    for state, verdict in ((0x2001, 1500), "good"), ((0x0040, 16_000_000), "advice"), (None, "advice"):
        monkeypatch.setattr(machine_checks, "kernel_clock", lambda state=state: state)
        assert told(machine_checks.clock_findings(tmp_path, NOW), "clock")[0][0] == verdict


def test_how_long_the_disk_lasts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = device_checks.loaded_options(config_of())

    def disk(free: float, config: Config | None = None) -> list[tuple[str, str]]:
        space = os.statvfs_result((4096, 4096, 10**9, 0, int(free // 4096), 0, 0, 0, 0, 255))
        monkeypatch.setattr(os, "statvfs", lambda _: space)
        return told(machine_checks.disk_findings(config or config_of(), options, tmp_path), "disk")

    # Two devices with three axes at 200 Hz: 1200 values a second, 0.197 GB a day; 0.54 GB stay free (least_free_bytes).
    ((verdict, says),) = disk(KEPT + 10 * 0.197e9)
    assert verdict == "good"
    assert "fill it in 10 days" in says
    assert disk(KEPT + 2 * 0.197e9)[0][0] == "advice"
    assert disk(0.5e9)[0][0] == "fault"
    for k in range(4):  # what was really recorded counts: 1 MB in 100 s, 0.864 GB a day
        path = tmp_path / f"fieldcal-{k + 1:06d}.mcap"
        path.write_bytes(bytes(1_000_000))
        os.utime(path, (NOW.timestamp() + 100 * k,) * 2)
    ((_, says),) = disk(KEPT + 0.864e9)
    assert "as the last 3 recordings show) fill it in 24 hours" in says


def test_a_bus_that_is_slower_than_stated(tmp_path: Path) -> None:
    node = tmp_path / "class/i2c-adapter/i2c-1/of_node"
    node.mkdir(parents=True)

    def bus(khz: int, rate_hz: float) -> str:
        (node / "clock-frequency").write_bytes((khz * 1000).to_bytes(4, "big"))
        options = Adxl355Options(rate_hz=rate_hz)
        ((verdict, _),) = told(device_checks.bus_findings({"mems": options}, tmp_path), "bus")
        return verdict

    assert [bus(400, 1000), bus(100, 1000), bus(100, 250)] == ["good", "fault", "advice"]


def test_devices_that_this_user_may_not_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "port"
    held = device_checks.loaded_options(config_of())["mems"].model_copy(update={"port": str(port)})
    ((verdict, says),) = told(device_checks.access_findings({"mems": held}), "device")
    assert (verdict, says) == ("fault", f"mems: {port} does not exist")
    port.touch()
    assert told(device_checks.access_findings({"mems": held}), "device")[0][0] == "good"
    monkeypatch.setattr(os, "access", lambda *_: False)
    (found,) = device_checks.access_findings({"mems": held})
    assert found.verdict == "fault"
    assert "usermod -aG" in found.remedy


def test_two_devices_at_one_place_and_a_sensor_with_one_axis(tmp_path: Path) -> None:
    (tmp_path / "by-id").symlink_to("/dev/none")
    raw = gateway("/dev/none", tmp_path / "by-id")
    raw["devices"][0]["options"]["axes"] = 1
    chip = {"driver": "adxl355", "options": {"rate_hz": 500, "address": 0x1D}}
    raw["devices"] += [
        {"name": "up", **chip},
        {"name": "down", **chip, "options": {"rate_hz": 500, "address": 0x53}},
        {"name": "again", **chip, "driver": "adxl357"},
        {"name": "shake", "driver": "shake-udp", "options": {"channels": ["ENZ"]}},
    ]
    config = parse_config(raw, "test")
    options = device_checks.loaded_options(config)
    found = {what.partition(";")[0] for _, what in contradictions(config, options)}
    assert found >= {
        "mems and reference are both at /dev/none: only one of them can be opened",
        "up and again are both at 0x1D on /dev/i2c-1: only one of them can be opened",
        "mems has one axis, and the sensor of a channel needs three",
    }
    shared = [says.partition(":")[0] for _, says in told(device_checks.sharing_findings(config, options), "bus")]
    assert shared == [
        "up shares /dev/i2c-1 with down",
        "down shares /dev/i2c-1 with up and again",
        "again shares /dev/i2c-1 with down",
    ]
    # The port of a Shake is a number in the network, and no device node.
    assert not [says for _, says in told(device_checks.access_findings(options), "device") if "shake" in says]


def test_a_router_that_answers_and_one_that_does_not() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        config = parse_config(gateway("/dev/none") | {"zenoh": {"connect": [f"tcp/127.0.0.1:{port}"]}}, "test")
        assert told(machine_checks.router_findings(config), "router")[0][0] == "good"
    assert told(machine_checks.router_findings(config), "router")[0][0] == "advice"


class Metered:
    """A sensor whose reads take no time: each makes a clock go on by half a second. So no other program delays it."""

    def __init__(self, rate_hz: float) -> None:
        self.now_ns, self._utc_ns = time.monotonic_ns() - 60 * 10**9, time.time_ns() - time.monotonic_ns()
        self._n, self._next = round(rate_hz / 2), 0

    def clock(self) -> tuple[int, int]:
        return self.now_ns, self.now_ns + self._utc_ns

    def open(self) -> DeviceInfo:
        return DeviceInfo("serial-csv", "lines", "", "m/s2", 3, 200.0)

    def read_block(self) -> SampleBlock:
        self.now_ns += 500_000_000
        first, self._next = self._next, self._next + self._n
        arrival_ns, counts = np.array([self.now_ns]), np.array([self._n], dtype=np.int32)
        utc_ns, values = self.clock()[1], np.tile([1.0, 2.0, 9.8], (self._n, 1))
        return SampleBlock("mems", boot_id(), utc_ns, first, 200.0, arrival_ns, counts, values)

    def take_drops(self) -> list[Drop]:
        return []

    def close(self) -> None:
        pass


@pytest.mark.parametrize(("rate_hz", "verdict"), [(200.0, "good"), (204.0, "good"), (206.0, "fault"), (150.0, "fault")])
def test_the_rate_that_a_device_delivers(rate_hz: float, verdict: str, monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Metered(rate_hz)
    config = parse_config(gateway("/dev/none"), "test")
    options = device_checks.loaded_options(config)
    monkeypatch.setattr(device_checks, "load_driver", lambda _: lambda *_: sensor)
    monkeypatch.setattr(device_checks, "system_clock", sensor.clock)
    in_its_time = SimpleNamespace(monotonic=lambda: sensor.now_ns * 1e-9, process_time=lambda: 0.0)
    monkeypatch.setattr(device_checks, "time", in_its_time)
    findings = device_checks.measured_findings(config, options, 2.5)
    assert told(findings, "throughput") == [(verdict, f"mems: {rate_hz:g} samples a second, nominal 200")]


def test_the_rates_that_a_running_agent_has_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, data_dir = tmp_path / "gateway.toml", tmp_path / "data"
    assert run_cli(["init", str(path), "--sensor", "adxl355", "--no-reference"]) == 0

    def clock(sequence: int, rate_hz: float) -> StoredResult:
        return StoredResult.of(
            ClockReport(
                run_id="run", sequence=sequence, sensor="sensor", t_utc_ns=sequence, device="sensor", role="sensor",
                nominal_rate_hz=1000.0, rate_hz=rate_hz, u_rate_hz=0.1, offset_s=0.0, u_offset_s=0.0, jitter_s=0.0,
                lag_s=math.nan, u_lag_s=math.nan, arrivals=100,
            ),
            recorded=True, recording="",
        )  # fmt: skip

    def throughput() -> list[tuple[str, str]]:
        capsys.readouterr()
        run_cli(["doctor", str(path), "--data-dir", str(data_dir), "--json", "-"])
        found = json.loads(capsys.readouterr().out)["findings"]
        return [(f["verdict"], f["says"]) for f in found if f["check"] == "throughput"]

    store = Store(data_dir, 0)  # holds the lock, as an agent does
    assert throughput() == [("good", "the agent runs; it tells the rates after its first minute")]
    store.commit([clock(1, 903.0), clock(2, 1003.0), clock(3, math.nan)])
    assert throughput() == [("good", "sensor: 1003 samples a second, nominal 1000")]
    store.commit([clock(4, 903.0)])
    assert throughput() == [("fault", "sensor: 903 samples a second, nominal 1000")]
    store.close()
    assert throughput() == [("good", "not measured")]


def test_the_command_tells_all_and_its_status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gateway.toml"
    assert run_cli(["init", str(path), "--sensor", "adxl355", "--sensor-option", "bus=250", "--no-reference"]) == 0
    capsys.readouterr()
    assert run_cli(["doctor", str(path), "--data-dir", str(tmp_path), "--json", "-"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert found["ok"] is False
    (missing,) = [f for f in found["findings"] if f["verdict"] == "fault"]
    assert missing["says"] == "sensor: /dev/i2c-250 does not exist"
    assert "modprobe i2c-dev" in missing["remedy"]
    assert run_cli(["doctor", "--data-dir", str(tmp_path)]) == 0, "without a configuration the machine alone"
    assert "0 faults" in capsys.readouterr().out
    path.write_text("[gateway]\nsite = 3\n")
    assert run_cli(["doctor", str(path), "--data-dir", str(tmp_path)]) == 3
    assert "line 2: gateway.site" in capsys.readouterr().out


def test_the_greatest_error_of_the_clock_stands_beside_the_estimated_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """struct timex of 64-bit Linux: modes, offset, freq, maxerror, esterror, status (adjtimex(2))."""

    def adjtimex(buffer: Any) -> int:
        struct.pack_into("@iqqqqi", buffer, 0, 0, -3, 5, 1500, 77, 64)
        return 0

    monkeypatch.setattr("agent.setup.machine_checks.ctypes.CDLL", lambda *_, **__: SimpleNamespace(adjtimex=adjtimex))
    assert machine_checks.kernel_clock() == (64, 1500)
