"""`fieldcal probe` on adapters under the real smbus2: which devices answer, their identity, the self-test."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from smbus2.smbus2 import I2cFunc

from agent.cli.main import run_cli
from hw.virtual.adxl345_twin import Adxl345Twin
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.icm20948_twin import Icm20948Twin
from hw.virtual.icm42688_twin import Icm42688Twin
from hw.virtual.kernel import SMBUS_FUNCTIONS, Adapter, I2CBus, installed
from hw.virtual.lis3dh_twin import Lis3dhTwin
from hw.virtual.lsm6dso_twin import Lsm6dsoTwin
from hw.virtual.mpu6050_twin import Mpu6050Twin, Mpu6500Twin
from hw.virtual.spi_bus import SpiBus


def noise(first: int, n: int) -> NDArray[np.int32]:
    return np.random.default_rng(first).integers(-3, 4, (n, 3), np.int32)


def twin(kind: Any, rate_hz: float, **known: Any) -> Any:
    return kind(noise, lambda t_s: int(t_s * rate_hz), time.monotonic, **known)


@pytest.fixture
def bus() -> Iterator[I2CBus]:
    bus = I2CBus({0x1D: twin(Adxl355Twin, 1000), 0x53: twin(Adxl345Twin, 800), 0x68: twin(Mpu6500Twin, 1000)})
    with installed({"/dev/i2c-4": bus}):
        yield bus


def probed(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> dict[int, dict[str, Any]]:
    assert run_cli(["probe", "--bus", "4", *arguments, "--json", "-"]) == status
    (found,) = json.loads(capsys.readouterr().out)["i2c"]
    return {answer["address"]: answer for answer in found["answers"]}


def test_who_answers(bus: I2CBus, capsys: pytest.CaptureFixture[str]) -> None:
    registers = {address: bytes(target.registers) for address, target in bus.targets.items()}  # type: ignore[attr-defined]
    found = probed(capsys)
    assert {address: answer["drivers"] for address, answer in found.items()} == {
        0x1D: ["adxl355", "adxl357"],  # the two parts have the same part ID
        0x53: ["adxl345"],
        0x68: ["mpu6050"],
    }
    assert found[0x68]["identity"] == "MPU-6500 (WHO_AM_I 0x70)"
    assert registers == {address: bytes(target.registers) for address, target in bus.targets.items()}  # type: ignore[attr-defined]


# 0x68 is an address of three drivers, 0x18 of one; each names its own part, and writes nothing.
@pytest.mark.parametrize(
    ("kind", "address", "driver", "identity"),
    [
        (Lis3dhTwin, 0x18, "lis3dh", "LIS3DH (WHO_AM_I 0x33)"),
        (Lis3dhTwin, 0x19, "lis3dh", "LIS3DH (WHO_AM_I 0x33)"),
        (Icm20948Twin, 0x68, "icm20948", "ICM-20948 (WHO_AM_I 0xEA)"),
        (Icm20948Twin, 0x69, "icm20948", "ICM-20948 (WHO_AM_I 0xEA)"),
        (Icm42688Twin, 0x68, "icm42688", "ICM-42688-P (WHO_AM_I 0x47)"),
        (Icm42688Twin, 0x69, "icm42688", "ICM-42688-P (WHO_AM_I 0x47)"),
        (Mpu6050Twin, 0x69, "mpu6050", "MPU-6050 (WHO_AM_I 0x68)"),
    ],
)
def test_drivers_that_share_an_address(
    bus: I2CBus, capsys: pytest.CaptureFixture[str], kind: Any, address: int, driver: str, identity: str
) -> None:
    written: list[bytes] = []

    class Watched(kind):  # type: ignore[misc]
        def _set(self, register: int, value: int) -> None:
            written.append(bytes([register, value]))

    bus.targets = {address: twin(Watched, 400)}
    assert {where: (found["drivers"], found["identity"]) for where, found in probed(capsys).items()} == {
        address: ([driver], identity)
    }
    assert written == []


def test_a_stranger_and_an_address_of_the_kernel(bus: I2CBus, capsys: pytest.CaptureFixture[str]) -> None:
    bus.targets[0x68] = twin(Adxl345Twin, 800)
    bus.claimed.add(0x1D)
    found = probed(capsys)
    assert found[0x1D]["drivers"] == found[0x68]["drivers"] == []
    assert "a kernel driver holds the address" in found[0x1D]["note"]
    assert "WHO_AM_I is 0x00" in found[0x68]["note"]


@pytest.mark.slow
def test_self_test_of_sound_and_stuck_parts(bus: I2CBus, capsys: pytest.CaptureFixture[str]) -> None:
    del bus.targets[0x53]
    found = probed(capsys, "--self-test")
    assert [answer["self_test"]["faults"] for answer in found.values()] == [[], []]
    bus.targets[0x1D]._deflection = lambda: np.zeros(3, np.int32)  # type: ignore[attr-defined]
    del bus.targets[0x68]
    (fault, *_) = probed(capsys, "--self-test", status=3)[0x1D]["self_test"]["faults"]
    assert fault.startswith("x changes by ")
    assert run_cli(["probe", "--bus", "4"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["/dev/i2c-4: ", "  0x1D  ADXL355 (REVID 0x01) or ADXL357 (REVID 0x01)", lines[2]]
    assert lines[2].strip() == "driver adxl355 or adxl357, one register read a transfer as here"


def test_a_part_that_answers_for_others_is_told_where_it_is_not_alone(
    bus: I2CBus, capsys: pytest.CaptureFixture[str]
) -> None:
    found = probed(capsys)
    assert {address: bool(answer["warning"]) for address, answer in found.items()} == {
        0x1D: True,
        0x53: False,
        0x68: False,
    }
    assert "REVID is below 3" in found[0x1D]["warning"]
    assert run_cli(["probe", "--bus", "4"]) == 0
    assert "warning: other devices answer on this bus" in capsys.readouterr().out
    bus.targets[0x1D].registers[3] = 3  # type: ignore[attr-defined]
    assert not probed(capsys)[0x1D]["warning"]
    bus.targets[0x1D].registers[3] = 2  # type: ignore[attr-defined]
    assert probed(capsys)[0x1D]["warning"]
    del bus.targets[0x53], bus.targets[0x68]
    assert not probed(capsys)[0x1D]["warning"]


def test_buses_that_cannot_be_asked(bus: I2CBus, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["probe", "--bus", "9"]) == 1
    assert capsys.readouterr().out.startswith("/dev/i2c-9 does not exist; state a bus that is there, or enable")
    bus.adapter = Adapter("bytes", functions=SMBUS_FUNCTIONS & ~I2cFunc.SMBUS_READ_I2C_BLOCK)
    assert run_cli(["probe", "--bus", "4"]) == 1
    assert "plain I2C" in capsys.readouterr().out


def test_ports_are_told_with_what_the_system_knows(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    board = {"port": "/dev/serial/by-id/usb-1", "description": "CP2102", "serial_number": "0001"}
    bare = {"port": "/dev/ttyS0", "description": "n/a", "serial_number": ""}
    monkeypatch.setattr("agent.cli.probe.serial_ports", lambda: [board, bare])
    assert run_cli(["probe"]) == 0
    assert capsys.readouterr().out.splitlines()[-3:] == [
        "/dev/serial/by-id/usb-1: serial port, CP2102, 0001",
        "/dev/ttyS0: serial port, of which the system knows nothing more",
        "a port is not opened here; `fieldcal init --sensor-port PORT` listens to it",
    ]


def on_spi(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> dict[str, Any]:
    assert run_cli(["probe", *arguments, "--json", "-"]) == status
    (found,) = json.loads(capsys.readouterr().out)["spi"]
    assert isinstance(found, dict)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("driver", "kind", "rate_hz", "says"),
    [
        ("adxl355", Adxl355Twin, 1000, "ADXL355 (REVID 0x01)"),
        ("adxl345", Adxl345Twin, 800, "ADXL345 (DEVID 0xE5)"),
        ("lsm6dso", Lsm6dsoTwin, 833, "LSM6DSO (WHO_AM_I 0x6C)"),
    ],
)
def test_a_device_on_spi_is_asked_as_the_driver_that_is_named(
    capsys: pytest.CaptureFixture[str], driver: str, kind: Any, rate_hz: float, says: str
) -> None:
    named = ["--bus", "spi0.1", "--driver", driver]
    chip = twin(kind, rate_hz)
    before = bytes(chip.registers)
    with installed({"/dev/spidev0.1": SpiBus(chip)}):
        found = on_spi(capsys, *named)
        assert (found["driver"], found["identity"]) == (driver, says)
        assert bytes(chip.registers) == before
        assert on_spi(capsys, *named, "--self-test")["self_test"]["faults"] == []
    with installed({"/dev/spidev0.1": SpiBus(None, idle=0)}):
        assert "no device answers, all bits read 0; check its supply" in on_spi(capsys, *named, status=1)["note"]
    with installed({}):
        assert "/dev/spidev0.1 does not exist; enable the SPI bus" in on_spi(capsys, *named, status=1)["note"]


def test_no_byte_is_sent_to_a_device_on_spi_that_nobody_names(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("agent.cli.probe.i2c_buses", list)
    monkeypatch.setattr("agent.cli.probe.spi_buses", lambda: ["spi0.0"])
    bus = SpiBus(twin(Adxl355Twin, 1000))
    with installed({"/dev/spidev0.0": bus}):
        for given, status in (([], 0), (["--driver", "adxl355"], 0), (["--bus", "spi0.0"], 1)):
            note = on_spi(capsys, *given, status=status)["note"]
            assert note.endswith("--bus spi0.0 --driver adxl345 or adxl355 or adxl357 or adxl359 or lsm6dso")
    assert bus.bytes == 0


def test_a_bus_or_driver_that_there_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    for given, says in (
        (["--bus", "spidev0.0"], "'spidev0.0' is neither N of /dev/i2c-N nor spiB.C of /dev/spidevB.C, as spi0.0"),
        (["--bus", "-1"], "'-1' is neither"),
        (["--driver", "adxl354"], "'adxl354' is none of adxl345, adxl355"),
    ):
        assert run_cli(["probe", *given]) == 2
        assert says in capsys.readouterr().err
    assert on_spi(capsys, "--bus", "spi0.0", "--driver", "mpu6050", status=1)["note"] == (
        "this driver does not read over SPI ('spi0.0'); use N of /dev/i2c-N"
    )
