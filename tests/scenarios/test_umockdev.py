"""The installed program, as a process, on simulated chips (register-level twins) that libumockdev presents to it.

The adapter takes what that of a Raspberry Pi Zero to 4 takes.
"""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from smbus2.smbus2 import I2cFunc

from agent.core.events import DeviceChange, Gap
from agent.recording.reading import RecordingReader
from hw.block import BlockFlags, SampleBlock
from hw.virtual.adxl345_twin import Adxl345Twin
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.fifo_twin import FifoTwin
from hw.virtual.icm42688_twin import Icm42688Twin
from hw.virtual.kernel import BCM2835, SMBUS_FUNCTIONS, Adapter, I2CBus
from hw.virtual.lis3dh_twin import Lis3dhTwin
from hw.virtual.lsm6dso_twin import Lsm6dsoTwin
from hw.virtual.mpu6050_twin import Mpu6050Twin
from hw.virtual.serial_port import PtyDevice, SampleLines
from hw.virtual.spi_bus import SpiBus
from tests.numbered import number, numbered, since_now
from tests.scenarios.processes import ROOT, interrupt, recordings, wait_until
from tests.scenarios.umockdev_site import UmockdevSite, absence

ABSENCE = absence()
pytestmark = pytest.mark.skipif(ABSENCE is not None, reason=str(ABSENCE))

NODE = "/dev/i2c-1"
# Rates at which no FIFO (the first two hold 32 samples) overflows while a machine under load runs other processes.
DEVICES: dict[str, tuple[type[FifoTwin], int, float]] = {
    "adxl355": (Adxl355Twin, 0x1D, 62.5),
    "adxl345": (Adxl345Twin, 0x53, 50.0),
    "mpu6050": (Mpu6050Twin, 0x68, 100.0),
    "lsm6dso": (Lsm6dsoTwin, 0x6A, 104.0),
    "lis3dh": (Lis3dhTwin, 0x18, 50.0),
    "icm42688": (Icm42688Twin, 0x69, 100.0),
}
SERIAL_HZ = 100.0


@pytest.fixture
def bus() -> I2CBus:
    return I2CBus(
        {address: twin(numbered, since_now(rate_hz), time.monotonic) for twin, address, rate_hz in DEVICES.values()},
        adapter=BCM2835,
    )


@pytest.fixture
def site(bus: I2CBus) -> Iterator[UmockdevSite]:
    with UmockdevSite({NODE: bus}) as site:
        yield site


@pytest.fixture
def port() -> Iterator[PtyDevice]:
    device = PtyDevice(SampleLines(lambda first, n: numbered(first, n).astype(float), since_now(SERIAL_HZ)))
    device.start()
    yield device
    device.stop()


def program(site: UmockdevSite, *arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-u", "-m", "agent", *map(str, arguments)],
        cwd=ROOT,
        env=os.environ | site.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def configuration(tmp_path: Path, port: PtyDevice) -> Path:
    lines = ['[gateway]\nsite = "test"\nname = "gateway"\n[zenoh]\nenabled = false\n[recording]\nflush_s = 0.5\n']
    lines += [
        f'[[devices]]\nname = "{name}"\ndriver = "{name}"\n'
        f"options = {{ bus = 1, address = {address}, rate_hz = {rate_hz} }}\n"
        for name, (_, address, rate_hz) in DEVICES.items()
    ]
    lines.append(
        '[[devices]]\nname = "serial"\ndriver = "serial-csv"\n'
        f'options = {{ port = "{port.path}", rate_hz = {SERIAL_HZ}, axes = 3, sequence = true, unit = "m/s2" }}\n'
    )
    lines += [f'[[channels]]\nsensor = "{name}"\nprior = {{}}\n' for name in (*DEVICES, "serial")]
    path = tmp_path / "gateway.toml"
    path.write_text("".join(lines))
    return path


def events(data_dir: Path) -> list[object]:
    return [step.event for file in recordings(data_dir) for step in RecordingReader(file).steps()]


def of(device: str, seen: list[object]) -> list[SampleBlock]:
    return [event for event in seen if isinstance(event, SampleBlock) and event.device == device]


def test_probe_names_who_answers(site: UmockdevSite, bus: I2CBus) -> None:
    bus.claimed.add(0x68)
    process = program(site, "probe", "--json", "-")
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 0, out
    (found,) = json.loads(out)["i2c"]
    assert (found["number"], found["fault"]) == (1, "")
    said = {answer["address"]: answer for answer in found["answers"]}
    assert sorted(said) == [0x18, 0x1D, 0x53, 0x68, 0x69, 0x6A]
    assert said[0x1D]["identity"].startswith("ADXL355 (REVID 0x01)")
    assert said[0x53]["identity"] == "ADXL345 (DEVID 0xE5)"
    assert [said[address]["drivers"] for address in (0x18, 0x69, 0x6A)] == [["lis3dh"], ["icm42688"], ["lsm6dso"]]
    assert "a kernel driver holds the address" in said[0x68]["note"]


def test_probe_names_a_bus_that_is_not_there(site: UmockdevSite) -> None:
    process = program(site, "probe", "--bus", "7")
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "/dev/i2c-7 does not exist; state a bus" in out


@pytest.mark.thorough
def test_check_and_doctor_ask_the_devices(tmp_path: Path, site: UmockdevSite, bus: I2CBus, port: PtyDevice) -> None:
    config = configuration(tmp_path, port)
    out, _ = (process := program(site, "check", config)).communicate(timeout=60)
    assert process.returncode == 0, out
    assert "  adxl355: ADXL355 (REVID 0x01) answers on /dev/i2c-1, one register read a transfer" in out.splitlines()
    del bus.targets[0x6A]
    out, _ = (process := program(site, "check", config)).communicate(timeout=60)
    assert process.returncode == 0, out
    assert "lsm6dso: LSM6DSO at 0x6A on /dev/i2c-1: no device answers (Remote I/O error)" in out
    process = program(site, "doctor", config, "--data-dir", tmp_path / "data", "--json", "-")
    findings = json.loads(process.communicate(timeout=60)[0])["findings"]
    said = {finding["says"]: finding["verdict"] for finding in findings if finding["check"] == "device"}
    assert said["mpu6050: MPU-6050 (WHO_AM_I 0x68) answers on /dev/i2c-1, one register read a transfer"] == "good"
    assert said["lsm6dso: LSM6DSO at 0x6A on /dev/i2c-1: no device answers (Remote I/O error)"] == "fault"
    bus.adapter = Adapter("single bytes", functions=SMBUS_FUNCTIONS & ~I2cFunc.SMBUS_READ_I2C_BLOCK)
    out, _ = (process := program(site, "check", config)).communicate(timeout=60)
    assert process.returncode == 2, out
    assert "the adapter can neither do plain I2C transfers nor read an I2C block over SMBus" in out


@pytest.mark.thorough
def test_who_uses_a_device_is_told(tmp_path: Path, site: UmockdevSite, port: PtyDevice) -> None:
    data_dir = tmp_path / "data"
    config = configuration(tmp_path, port)
    running = program(site, "run", config, "--data-dir", data_dir)
    try:
        wait_until(lambda: all(of(name, events(data_dir)) for name in DEVICES), 60, "samples of all come")
        out, _ = (process := program(site, "probe", "--json", "-")).communicate(timeout=60)
        assert process.returncode == 0, out
        used = {answer["address"]: answer["used_by"] for answer in json.loads(out)["i2c"][0]["answers"]}
        assert set(used) == {0x18, 0x1D, 0x53, 0x68, 0x69, 0x6A}
        assert all(f"process {running.pid} (" in by for by in used.values())
        process = program(site, "run", config, "--data-dir", tmp_path / "second", "--duration", "2")
        out, _ = process.communicate(timeout=60)
        assert f"ADXL355 at 0x1D on /dev/i2c-1: process {running.pid} (" in out
    finally:
        interrupt(running)
        running.communicate(timeout=60)


def test_a_run_loses_no_sample_of_any_device(tmp_path: Path, site: UmockdevSite, port: PtyDevice) -> None:
    data_dir = tmp_path / "data"
    process = program(site, "run", configuration(tmp_path, port), "--data-dir", data_dir, "--duration", "6")
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 0, out
    assert "Traceback" not in out
    seen = events(data_dir)
    assert [event for event in seen if isinstance(event, Gap)] == []
    rates_hz = {name: rate_hz for name, (_, _, rate_hz) in DEVICES.items()} | {"serial": SERIAL_HZ}
    for name, rate_hz in rates_hz.items():
        blocks = of(name, seen)
        assert [block.flags for block in blocks] == [BlockFlags.RESTART] + [BlockFlags.NONE] * (len(blocks) - 1), name
        numbers = np.concatenate([number(block.indications) for block in blocks])
        assert (np.diff(numbers) == 1).all(), name
        assert len(numbers) > 4 * rate_hz, name  # of 6 s; the rest is the opening of the devices and the last block


@pytest.mark.thorough
def test_unplugged_and_back_it_goes_on(tmp_path: Path, site: UmockdevSite, bus: I2CBus, port: PtyDevice) -> None:
    data_dir = tmp_path / "data"
    process = program(site, "run", configuration(tmp_path, port), "--data-dir", data_dir)
    try:
        wait_until(lambda: all(of(name, events(data_dir)) for name in DEVICES), 60, "samples of all come")
        site.unplug(NODE)
        wait_until(lambda: lost(data_dir) == set(DEVICES), 60, "all on the bus are lost")
        site.replug(NODE)
        wait_until(lambda: not lost(data_dir), 60, "all are back")
        for target in bus.targets.values():
            assert isinstance(target, FifoTwin)
            target.fail(errno.EREMOTEIO, 3)  # three errors only, then it works again
        before = {name: len(of(name, events(data_dir))) for name in DEVICES}
        wait_until(
            lambda: all(len(of(name, events(data_dir))) > n + 1 for name, n in before.items()), 20, "samples go on"
        )
    finally:
        interrupt(process)
        out, _ = process.communicate(timeout=60)
    assert process.returncode == 0, out
    assert "Traceback" not in out
    seen = events(data_dir)
    losses = [event for event in seen if isinstance(event, DeviceChange) and event.state == "lost"]
    assert {event.device for event in losses} == set(DEVICES)
    assert any("Input/output error" in event.message for event in losses)
    assert len(of("serial", seen)) > 2
    for name in DEVICES:
        blocks = of(name, seen)
        for block in blocks:
            assert (np.diff(number(block.indications)) == 1).all(), name
        assert sum(bool(block.flags & BlockFlags.RESTART) for block in blocks) >= 2


def lost(data_dir: Path) -> set[str]:
    """Devices whose last DeviceChange is "lost"."""
    last = {event.device: event.state for event in events(data_dir) if isinstance(event, DeviceChange)}
    return {name for name, state in last.items() if state == "lost"}


@pytest.mark.nightly
def test_the_same_chips_over_spi(tmp_path: Path) -> None:
    chips = {name: (twin, rate_hz) for name, (twin, _, rate_hz) in DEVICES.items() if twin.spi_modes}
    buses = {
        f"/dev/spidev0.{select}": SpiBus(twin(numbered, since_now(rate_hz), time.monotonic))
        for select, (twin, rate_hz) in enumerate(chips.values())
    }
    lines = ['[gateway]\nsite = "test"\nname = "gateway"\n[zenoh]\nenabled = false\n[recording]\nflush_s = 0.5\n']
    for select, (name, (_, rate_hz)) in enumerate(chips.items()):
        lines += [
            f'[[devices]]\nname = "{name}"\ndriver = "{name}"\n'
            f'options = {{ bus = "spi0.{select}", rate_hz = {rate_hz} }}\n'
            f'[[channels]]\nsensor = "{name}"\nprior = {{}}\n'
        ]
    config, data_dir = tmp_path / "gateway.toml", tmp_path / "data"
    config.write_text("".join(lines))
    with UmockdevSite(buses) as site:
        out, _ = (process := program(site, "probe", "--json", "-")).communicate(timeout=60)
        assert process.returncode == 0, out
        assert [one["bus"] for one in json.loads(out)["spi"]] == ["spi0.0", "spi0.1", "spi0.2"]
        assert all(bus.bytes == 0 for bus in buses.values())
        out, _ = (process := program(site, "check", config)).communicate(timeout=60)
        assert process.returncode == 0, out
        assert "  adxl345: ADXL345 (DEVID 0xE5) answers on /dev/spidev0.1, one register read a transfer" in out
        process = program(site, "doctor", config, "--data-dir", data_dir, "--json", "-")
        found = json.loads(process.communicate(timeout=60)[0])["findings"]
        assert all(one["verdict"] == "good" for one in found if one["check"] in ("device", "bus")), found
        out, _ = (process := program(site, "run", config, "--data-dir", data_dir, "--duration", "6")).communicate(
            timeout=60
        )
        assert process.returncode == 0, out
    seen = events(data_dir)
    assert [event for event in seen if isinstance(event, Gap)] == []
    for name, (_, rate_hz) in chips.items():
        numbers = np.concatenate([number(block.indications) for block in of(name, seen)])
        assert (np.diff(numbers) == 1).all(), name
        assert len(numbers) > 4 * rate_hz, name
