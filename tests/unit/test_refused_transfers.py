"""Adapters that refuse what the drivers need: the run ends with status 2 where no channel can work, else it goes on."""

from __future__ import annotations

import os
import time
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.acquisition.service import Service, refusals
from agent.cli.run import serve
from agent.config import Config, parse_config
from agent.core.events import DeviceChange
from agent.recording.reading import RecordingReader
from agent.terminal.watch import RunView
from hw.block import SampleBlock
from hw.virtual.adxl345_twin import Adxl345Twin
from hw.virtual.kernel import BCM2835, SMBUS_ONLY, Adapter, I2CBus, installed
from tests.scenarios.processes import ROOT, fieldcal, recordings
from tests.unit.buggy_driver import REFUSED, install

TOO_SHORT = Adapter("messages of 5 bytes", longest=5)
STANDS = {"start_s": 0, "stop_s": 3600}


def channel(sensor: str, reference: str = "", check: str = "") -> dict[str, Any]:
    """A channel of these devices."""
    how = {"theta_deg": 30, "alpha_deg": 20} if reference else {"gravity_mps2": [0, 0, 9.81]}
    found: dict[str, Any] = {"sensor": sensor, "prior": {}, "poses": [STANDS | how]}
    found |= {"reference": reference, "certificate": {}} if reference else {}
    return found | ({"check_reference": {"device": check}} if check else {})


def configuration(channels: list[dict[str, Any]]) -> Config:
    """Devices a to d, and these channels."""
    devices = [{"name": name, "driver": "virtual", "options": {"role": "sensor"}} for name in "abcd"]
    return parse_config({"devices": devices, "channels": channels, "zenoh": {"enabled": False}}, "test")


CASES = [
    ([channel("a")], "", False),
    ([channel("a")], "a", True),
    ([channel("a")], "b", False),
    ([channel("a"), channel("b")], "a", False),
    ([channel("a"), channel("b")], "ab", True),
    ([channel("a", "b")], "b", True),
    ([channel("a", "b")], "a", True),
    ([channel("a", "b", "c")], "b", False),
    ([channel("a", "b", "c")], "c", False),
    ([channel("a", "b", "c")], "bc", True),
    ([channel("a", "b"), channel("c", "b")], "b", True),
    ([channel("a", "b"), channel("c", "d")], "bc", True),
    ([channel("a", "b"), channel("c")], "ab", False),
]


@pytest.mark.parametrize(("channels", "refused", "ends"), CASES)
def test_a_channel_can_work_with_its_sensor_and_one_of_its_references(
    channels: list[dict[str, Any]], refused: str, ends: bool
) -> None:
    found = refusals(configuration(channels).channels, dict.fromkeys(refused, REFUSED))
    assert found == ([f"{device}: {REFUSED}" for device in refused] if ends else [])


CONFIG = """
zenoh = {{ enabled = false }}
recording = {{ flush_s = 0.2 }}
devices = [
    {{ name = "imu", driver = "buggy", options = {{ bug = "{bug}", times = {times} }} }},
    {{ name = "good", driver = "buggy" }},
]
channels = [{channels}]
"""
CHANNEL = '{{ sensor = "{}", prior = {{}}, poses = [{{ start_s = 0, stop_s = 3600, gravity_mps2 = [0, 0, 9.81] }}] }}'


@pytest.fixture
def plug_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}{os.pathsep}{tmp_path}")


def ran(tmp_path: Path, channels: list[str], bug: str, times: int, duration_s: float) -> CompletedProcess[str]:
    """Run the program on a device with the bug and a good one, with these channels."""
    path = tmp_path / "config.toml"
    stated = ", ".join(CHANNEL.format(name) for name in channels)
    path.write_text(CONFIG.format(bug=bug, times=times, channels=stated))
    return fieldcal("run", path, "--data-dir", tmp_path / "data", "--duration", str(duration_s))


@pytest.mark.thorough
@pytest.mark.usefixtures("plug_in")
def test_run_ends_with_2_where_no_channel_can_work(tmp_path: Path) -> None:
    done = ran(tmp_path, ["imu"], "the adapter refuses", times=10**9, duration_s=50)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [f"fieldcal run: imu: {REFUSED}"]
    (file,) = recordings(tmp_path / "data")
    assert file.suffix == ".mcap", "the recording is closed"
    assert fieldcal("audit", file).returncode == 0


@pytest.mark.thorough
@pytest.mark.usefixtures("plug_in")
def test_the_others_go_on_where_a_channel_can_work(tmp_path: Path) -> None:
    done = ran(tmp_path, ["imu", "good"], "the adapter refuses", times=10**9, duration_s=4)
    assert done.returncode == 0
    assert f"imu is lost: {REFUSED}" in done.stdout
    (file,) = recordings(tmp_path / "data")
    events = [step.event for step in RecordingReader(file).steps()]
    opened = [e.device for e in events if isinstance(e, DeviceChange) and e.state == "open"]
    assert opened == ["good"]


@pytest.mark.slow
@pytest.mark.usefixtures("plug_in")
def test_an_adapter_that_refuses_what_it_took_before_does_not_end_the_run(tmp_path: Path) -> None:
    done = ran(tmp_path, ["imu"], "the adapter refuses later", times=1, duration_s=8)
    assert done.returncode == 0
    assert done.stderr == ""
    (file,) = recordings(tmp_path / "data")
    changes = [e for e in (step.event for step in RecordingReader(file).steps()) if isinstance(e, DeviceChange)]
    assert [change.state for change in changes if change.device == "imu"] == ["open", "lost", "open"]


def bus(adapter: Adapter) -> I2CBus:
    """A bus with an ADXL345 of 100 Hz at 0x53."""
    began_s = time.monotonic()

    def counts(first: int, n: int) -> NDArray[np.int32]:
        return (
            np.tile(np.array([0, 0, 256], np.int32), (n, 1)) + np.arange(first, first + n, dtype=np.int32)[:, None] % 2
        )

    twin = Adxl345Twin(counts, lambda now_s: int((now_s - began_s) * 100.0), time.monotonic)
    return I2CBus({0x53: twin}, adapter=adapter)


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("adapters", "status"),
    [([TOO_SHORT], 2), ([TOO_SHORT, TOO_SHORT], 2), ([TOO_SHORT, BCM2835], 0), ([BCM2835, SMBUS_ONLY], 0)],
    ids=["one refuses", "both refuse", "one refuses of two", "both take it"],
)
def test_adapters_of_the_twins(
    tmp_path: Path, adapters: list[Adapter], status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [f"imu{k}" for k in range(len(adapters))]
    options = [{"bus": k, "rate_hz": 100, "address": 0x53} for k in range(len(adapters))]
    raw = {
        "devices": [{"name": n, "driver": "adxl345", "options": o} for n, o in zip(names, options, strict=True)],
        "channels": [channel(name) for name in names],
        "recording": {"flush_s": 0.2},
        "zenoh": {"enabled": False},
    }
    nodes = {f"/dev/i2c-{k}": bus(adapter) for k, adapter in enumerate(adapters)}
    config = parse_config(raw, "test")
    with installed(nodes), RunView(config, "test", None) as watch:
        began_s = time.monotonic()
        assert serve(Service(config, tmp_path, watch), 4.0 if status == 0 else 60.0) == status
        assert status == 0 or time.monotonic() - began_s < 20.0, "it ends at once"
    refusing = [name for name, adapter in zip(names, adapters, strict=True) if adapter is TOO_SHORT]
    said = capsys.readouterr()
    lines = said.err.splitlines()
    assert [line.split(": ")[:2] for line in lines] == ([["fieldcal run", name] for name in refusing] if status else [])
    assert all("the adapter" in line for line in lines)
    for name in refusing:
        assert f"{name} is lost: ADXL345 at 0x53 on /dev/i2c-{names.index(name)}: the adapter" in said.out
    (file,) = recordings(tmp_path)
    blocks = {e.device for e in (step.event for step in RecordingReader(file).steps()) if isinstance(e, SampleBlock)}
    assert blocks == {name for name in names if name not in refusing}
