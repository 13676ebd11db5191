"""Where a device is faulty, the agent gives a message or counts an event, and goes on."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.acquisition.service import Service
from agent.cli.main import run_cli
from agent.config import parse_config
from agent.core.events import DeviceChange, Gap
from agent.recording.reading import RecordingReader
from agent.terminal.watch import RunView
from hw.block import SampleBlock
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.kernel import I2CBus, installed
from hw.virtual.serial_port import PtyDevice
from tests.scenarios.processes import interrupt, recordings, results, started, wait_until

CONFIG = """
[gateway]
site = "test"
name = "devices"
[[devices]]
name = "imu"
driver = "serial-csv"
options = {{ port = "{port}", rate_hz = 100, axes = 3, sequence = true, unit = "m/s2" }}
[[channels]]
sensor = "imu"
prior = {{}}
silence_s = 2
poses = [{{ start_s = 0, stop_s = 3600, gravity_mps2 = [0, 0, 9.81] }}]
[zenoh]
enabled = false
"""


class Lines:
    """Sends a sample each 10 ms: its number, and gravity on z."""

    def __init__(self) -> None:
        self._began_s: float | None = None
        self._sent = 0

    def __call__(self, t_s: float) -> bytes:
        if self._began_s is None:
            self._began_s = t_s
        due = int((t_s - self._began_s) * 100)
        text = "".join(f"{k},0.01,-0.02,9.81\n" for k in range(self._sent, due))
        self._sent = due
        return text.encode()


@pytest.fixture
def port(tmp_path: Path) -> Iterator[PtyDevice]:
    device = PtyDevice(Lines(), link=tmp_path / "port")
    device.start()
    yield device
    device.stop()


def configuration(tmp_path: Path, port: Path) -> Path:
    path = tmp_path / "config.toml"
    path.write_text(CONFIG.format(port=port))
    return path


def statuses(data_dir: Path) -> list[str]:
    return [status["status"] for status in results(data_dir, "status")]


def events(data_dir: Path) -> list[Any]:
    if not data_dir.exists():
        return []
    return [step.event for file in recordings(data_dir) for step in RecordingReader(file).steps()]


def test_unplugged_and_back_it_goes_on(tmp_path: Path, port: PtyDevice) -> None:
    data_dir, output = tmp_path / "data", tmp_path / "output"
    with started("run", configuration(tmp_path, port.path), "--data-dir", data_dir, output=output) as agent:
        wait_until(lambda: port.has_reader() and recordings(data_dir), 60, "the port is open")
        for _ in range(2):
            before = len(statuses(data_dir))
            port.unplug()
            wait_until(lambda n=before: "INVALID" in statuses(data_dir)[n:], 60, "INVALID after the unplugging")
            port.replug()
            wait_until(lambda: statuses(data_dir)[-1] != "INVALID", 60, "it goes on")
        interrupt(agent)
    assert agent.returncode == 0
    assert "Traceback" not in output.read_text()
    changes = [event.state for event in events(data_dir) if isinstance(event, DeviceChange)]
    turns = [state for state, _ in itertools.groupby(changes)]  # lost again, where it could not be opened meanwhile
    assert turns[-4:] == ["lost", "open", "lost", "open"]


@pytest.mark.thorough
def test_garbage_is_counted_and_the_samples_go_on(tmp_path: Path, port: PtyDevice) -> None:
    data_dir, output = tmp_path / "data", tmp_path / "output"
    with started("run", configuration(tmp_path, port.path), "--data-dir", data_dir, output=output) as agent:
        wait_until(lambda: any(isinstance(e, SampleBlock) for e in events(data_dir)), 60, "samples come")
        for garbage in (b"\x00\xff\xfe\n", b"nan,nan,nan,nan\n", b"7,1e999,0,0\n", b"9" * 5000 + b"\n"):
            said = output.read_text().count("dropped")
            port.inject(garbage)
            wait_until(lambda n=said: output.read_text().count("dropped") > n, 60, f"{garbage[:20]!r} is said")
        wait_until(lambda: agent.poll() is None, 1, "it runs")
        interrupt(agent)
    assert agent.returncode == 0
    assert "Traceback" not in output.read_text()
    seen = events(data_dir)
    assert sum(event.dropped for event in seen if isinstance(event, Gap) and event.unit == "lines") >= 3
    assert not any(isinstance(event, DeviceChange) and event.state == "lost" for event in seen)


@pytest.mark.thorough
def test_a_missing_port_is_said_and_waited_for(tmp_path: Path) -> None:
    data_dir, output, link = tmp_path / "data", tmp_path / "output", tmp_path / "late-port"
    with started("run", configuration(tmp_path, link), "--data-dir", data_dir, output=output) as agent:
        wait_until(lambda: str(link) in output.read_text() and "INVALID" in statuses(data_dir), 60, "it is said")
        device = PtyDevice(Lines(), link=link)
        device.start()
        try:
            wait_until(lambda: statuses(data_dir)[-1] != "INVALID", 60, "it starts once the port is there")
        finally:
            interrupt(agent)
            device.stop()
    assert agent.returncode == 0
    assert "Traceback" not in output.read_text()


@pytest.mark.thorough
def test_a_silent_device_turns_the_status_invalid_by_tick(tmp_path: Path) -> None:
    silent = itertools.repeat(b"")
    device = PtyDevice(lambda _: next(silent), link=tmp_path / "port")
    device.start()
    data_dir = tmp_path / "data"
    try:
        config = configuration(tmp_path, device.path)
        with started("run", config, "--data-dir", data_dir, output=tmp_path / "output") as agent:
            wait_until(lambda: "INVALID" in statuses(data_dir), 60, "INVALID without a block")
            interrupt(agent)
    finally:
        device.stop()
    assert "no block of imu" in results(data_dir, "status")[-1]["reason"]


def test_a_wrong_chip_is_named_and_does_not_stop_the_agent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raw = {
        "devices": [{"name": "mems", "driver": "adxl355", "options": {"bus": 1}}],
        "channels": [{"sensor": "mems", "silence_s": 2, "prior": {}}],
        "zenoh": {"enabled": False},
    }
    config = parse_config(raw, "test")
    nothing = np.empty((0, 3), dtype=np.int32)
    identity = bytes([0xAD, 0x1D, 0xE5, 0x01])
    twin = Adxl355Twin(lambda _first, _n: nothing, lambda _t_s: 0, time.monotonic, identity=identity)
    with installed({"/dev/i2c-1": I2CBus({0x1D: twin})}), RunView(config, "test", None) as watch:
        service = Service(config, tmp_path, watch)
        runner = threading.Thread(target=service.run, args=(None,))
        runner.start()
        try:
            wait_until(lambda: "INVALID" in statuses(tmp_path), 60, "the status says it")
        finally:
            service.stop()
            runner.join(60)
    assert not runner.is_alive()
    said = capsys.readouterr().out
    assert "0x1D" in said
    assert "E5" in said.upper()


FAULTS = [
    ("enabled = false", "enabled = false\ncolour = 3", "zenoh.colour"),
    ('driver = "serial-csv"', 'driver = "serial-cvs"', "did you mean 'serial-csv'"),
    ("rate_hz = 100", 'rate_hz = "fast"', "devices.0.options.rate_hz"),
    ("silence_s = 2", "silence_s = -2", "channels.0.silence_s"),
    ('sensor = "imu"', 'sensor = "imo"', "imo"),
]


@pytest.mark.one_case
@pytest.mark.parametrize(("old", "new", "named"), FAULTS, ids=[named for _, _, named in FAULTS])
def test_a_faulty_configuration_is_refused_with_path_and_value(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], old: str, new: str, named: str
) -> None:
    path = configuration(tmp_path, Path("/dev/ttyUSB0"))
    path.write_text(path.read_text().replace(old, new))
    commands: tuple[list[str | Path], ...] = (
        ["check", path], ["run", path, "--data-dir", tmp_path / "data", "--duration", "5"],
    )  # fmt: skip
    for command in commands:
        assert run_cli([str(word) for word in command]) == 2
        told = capfd.readouterr().err
        assert str(path) in told
        assert named in told
        assert "Traceback" not in told
    assert not (tmp_path / "data").exists()
