"""SPI over spidev: the kernel's numbers, the bytes of each chip, and what users report of controllers and wires."""

from __future__ import annotations

import ctypes
import errno
import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from pydantic import ValidationError

import hw.spi
from agent.core.identity import identity_of
from hw.adxl345 import Adxl345, Adxl345Options
from hw.adxl355 import Adxl355, Adxl355Options
from hw.fifo_sensor import FifoSensor
from hw.lsm6dso import Lsm6dso, Lsm6dsoOptions
from hw.mpu6050 import Mpu6050Options
from hw.sensor import ConfigurationError, DeviceLost
from hw.spi import SpiDevice, Transfer, message
from hw.virtual.adxl345_twin import Adxl345Twin
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.fifo_twin import FifoTwin
from hw.virtual.kernel import I2CBus, installed
from hw.virtual.lsm6dso_twin import Lsm6dsoTwin
from hw.virtual.spi_bus import Controller, SpiBus

HEADER = Path("/usr/include/linux/spi/spidev.h")
NODE = "/dev/spidev0.0"
FIELDS = [name for name, *_ in Transfer._fields_]
PARTS: list[tuple[Any, Any, Any]] = [
    (Adxl355, Adxl355Options, Adxl355Twin),
    (Adxl345, Adxl345Options, Adxl345Twin),
    (Lsm6dso, Lsm6dsoOptions, Lsm6dsoTwin),
]


@pytest.mark.skipif(not HEADER.exists() or not shutil.which("cc"), reason="needs a C compiler and the kernel's headers")
def test_numbers_are_those_of_the_kernels_header(tmp_path: Path) -> None:
    source = tmp_path / "numbers.c"
    offsets = "".join(f'printf("%zu\\n", offsetof(struct spi_ioc_transfer, {name}));' for name in FIELDS)
    source.write_text(
        "#include <stddef.h>\n#include <stdio.h>\n#include <sys/ioctl.h>\n#include <linux/spi/spidev.h>\n"
        'int main(void) { printf("%lu\\n%lu\\n%lu\\n%lu\\n%lu\\n%zu\\n", (unsigned long)SPI_IOC_RD_MODE32,'
        "(unsigned long)SPI_IOC_WR_MODE32, (unsigned long)SPI_IOC_MESSAGE(1), (unsigned long)SPI_IOC_MESSAGE(21),"
        "(unsigned long)SPI_CS_HIGH, sizeof(struct spi_ioc_transfer));" + offsets + "return 0; }\n"
    )
    subprocess.run(["cc", "-o", tmp_path / "numbers", source], check=True)
    printed = subprocess.run([tmp_path / "numbers"], check=True, capture_output=True, text=True).stdout
    ours = [hw.spi.RD_MODE32, hw.spi.WR_MODE32, message(1), message(21), hw.spi.CS_HIGH, ctypes.sizeof(Transfer)]
    assert [int(line) for line in printed.split()] == ours + [getattr(Transfer, name).offset for name in FIELDS]


class Wire:
    """A device that notes the frames and answers with the bytes that it is given."""

    spi_modes: ClassVar[tuple[int, ...]] = (0, 1, 2, 3)
    spi_highest_hz: ClassVar[float] = 1e9

    def __init__(self, answer: bytes = b"") -> None:
        self.frames: list[bytes] = []
        self.answer = answer

    def exchange(self, sent: bytes) -> bytes:
        self.frames.append(sent)
        return (b"\0" + self.answer + bytes(len(sent)))[: len(sent)]


# Read of register 0, of five bytes from register 0x2C, and write of 0x0A to it. ADXL355: a user's log of a working
# device (ez.analog.com 91063: command 1 reads register 0) and Linux, adxl355_spi.c. ADXL345: Linux, adxl34x-spi.c (0x80
# for a read, and 0x40 for several bytes). LSM6DSO: Linux, st_lsm6dsx_spi.c, bit 7.
@pytest.mark.parametrize(
    ("options", "mode", "commands"),
    [
        (Adxl355Options, 0, (0x01, 0x59, 0x58)),
        (Adxl345Options, 3, (0x80, 0xEC, 0x2C)),
        (Lsm6dsoOptions, 0, (0x80, 0xAC, 0x2C)),
    ],
)
def test_the_bytes_on_the_wire(options: Any, mode: int, commands: tuple[int, int, int]) -> None:
    wire = Wire(b"\x01\x02\x03\x04\x05")
    bus = SpiBus(wire)
    device = SpiDevice("chip", "spi0.0", options.spi, 1e6, time.sleep)
    with installed({NODE: bus}):
        device.open()
        assert bus.mode == mode
        device.check_free(0)  # the first transfer behind a change of the mode does not count
        wire.frames.clear()
        assert device.read(0x00, 1) == b"\x01"
        assert device.read(0x2C, 5) == b"\x01\x02\x03\x04\x05"
        device.write(0x2C, 0x0A)
        device.close()
    one, five, write = commands
    assert wire.frames == [bytes([one, 0]), bytes([five, 0, 0, 0, 0, 0]), bytes([write, 0x0A])]


class Now:
    """A simulated time, s."""

    def __init__(self, t_s: float = 0.0) -> None:
        self.t_s = t_s

    def __call__(self) -> float:
        return self.t_s

    def sleep(self, seconds: float) -> None:
        self.t_s += seconds

    def clock(self) -> tuple[int, int]:
        return round(self.t_s * 1e9), 0

    @staticmethod
    def due(rate_hz: float) -> Callable[[float], int]:
        return lambda t_s: int(t_s * rate_hz)


def built(driver: type[FifoSensor], options: Any, **given: Any) -> FifoSensor:
    return driver("sensor", options(bus="spi0.0", **given))


def chip(kind: type[FifoTwin], rate_hz: float = 1000.0) -> Any:
    return kind(lambda _, n: np.ones((n, 3), np.int32), lambda t_s: int(t_s * rate_hz), time.monotonic)


@pytest.mark.parametrize(("driver", "options", "kind"), PARTS)
def test_what_another_program_left_in_the_mode_does_not_matter(driver: Any, options: Any, kind: Any) -> None:
    # LSB first, three wires, loop-back and the wrong phase stay set in the node; an active-high chip select belongs to
    # the board (raspberrypi/linux issue 3745, SPI-Py pull request 25) and must stay.
    bus = SpiBus(chip(kind), adapter=Controller("wired high", wiring=0x04))
    bus.mode = 0x04 | 0x08 | 0x10 | 0x20 | 0x01
    with installed({NODE: bus}):
        sensor = built(driver, options)  # type: ignore[type-abstract]
        sensor.open()
        sensor.close()
    assert bus.mode == 0x04 | options.spi.mode


@pytest.mark.parametrize(("driver", "options", "kind"), PARTS)
@pytest.mark.parametrize("idle", [0x00, 0xFF])
def test_a_device_that_is_not_there(driver: Any, options: Any, kind: Any, idle: int) -> None:
    # "got 0 vs e5", "got ff vs e5": Klipper issue 3637. It may be connected later, so it is lost, not misconfigured.
    bus = SpiBus(None, idle=idle)
    with installed({NODE: bus}):
        sensor = built(driver, options)  # type: ignore[type-abstract]
        for ask in (sensor.open, sensor.identify):
            with pytest.raises(DeviceLost, match=f"no device answers, all bits read {idle & 1}; check its supply"):
                ask()
        bus.target = chip(kind)
        sensor.open()
        bus.target = None
        with pytest.raises(DeviceLost):
            sensor.read_block()
        sensor.close()


def test_a_controller_that_does_not_deselect_between_frames_gets_one_frame_a_message() -> None:
    for adapter, joins in ((Controller("good"), True), (Controller("one selection", deselects=False), False)):
        for driver, options, kind in PARTS:
            with installed({NODE: SpiBus(chip(kind), adapter=adapter)}):
                sensor = built(driver, options)  # type: ignore[type-abstract]
                sensor.open()
                assert sensor._device.joins == joins, kind
                sensor.close()


@pytest.mark.parametrize("bufsiz", [16, 64, 128, 4096])
def test_no_message_is_longer_than_spidev_takes(bufsiz: int) -> None:
    # luma.core pull request 20: nodes with 64 or 128 bytes
    for driver, options, kind in PARTS:
        now = Now()
        given = options(bus="spi0.0")
        rate_hz = {833.0: 6667 / 8}.get(given.rate_hz, given.rate_hz)  # what the part states of itself
        twin = kind(lambda _, n: np.ones((n, 3), np.int32), now.due(rate_hz), now)
        with installed({NODE: SpiBus(twin, adapter=Controller("short", bufsiz=bufsiz))}):
            sensor = driver("sensor", given, clock=now.clock, sleep=now.sleep)
            sensor.open()
            block = sensor.read_block()
            assert block is not None
            assert (block.indications == 1).all()
            sensor.close()


def test_a_node_that_is_not_there_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hw.spi.SYSFS", tmp_path)
    sensor = built(Adxl355, Adxl355Options)
    device = tmp_path / "bus/spi/devices/spi0.0"
    with installed({}):
        with pytest.raises(DeviceLost, match=r"/dev/spidev0\.0 does not exist; enable the SPI bus .*dtparam=spi=on"):
            sensor.open()
        device.mkdir(parents=True)
        with pytest.raises(DeviceLost, match=r"no kernel driver has spi0\.0: sudo modprobe spidev"):
            sensor.open()
        (tmp_path / "bus/spi/drivers/enc28j60").mkdir(parents=True)
        (device / "driver").symlink_to(tmp_path / "bus/spi/drivers/enc28j60")
        with pytest.raises(ConfigurationError, match=r"because the kernel driver enc28j60 holds spi0\.0; remove"):
            sensor.open()


def test_a_node_that_this_user_may_not_open(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(DeviceLost, match=r"/dev/spidev0\.0: Permission denied; add the user .*usermod -aG spi USER"):
        built(Adxl355, Adxl355Options).open()


def test_a_device_that_is_unbound_underway() -> None:
    bus = SpiBus(chip(Adxl355Twin))
    with installed({NODE: bus}):
        sensor = built(Adxl355, Adxl355Options)
        sensor.open()
        bus.unplug()
        with pytest.raises(DeviceLost, match=f"{NODE}: Cannot send after transport endpoint shutdown"):
            sensor.read_block()
        sensor.close()


def test_identity_and_settings_are_those_on_i2c() -> None:
    for driver, options, kind in PARTS:
        twin = chip(kind)
        with installed({NODE: SpiBus(twin), "/dev/i2c-1": I2CBus({options().address: twin})}):
            infos = []
            for given in ({"bus": "spi0.0"}, {}):
                sensor = driver("sensor", options(**given))
                infos.append(sensor.open())
                sensor.close()
        over_spi, over_i2c = infos
        assert over_spi == over_i2c
        assert identity_of(json.dumps(asdict(over_spi))) == identity_of(json.dumps(asdict(over_i2c)))


@pytest.mark.parametrize(
    ("options", "given", "says"),
    [
        (Adxl355Options, {"address": 0x1D}, "address does not apply to bus spi0.0, remove it: on SPI the chip select"),
        (Lsm6dsoOptions, {"bus_khz": 400}, "bus_khz does not apply to bus spi0.0"),
        (Adxl355Options, {"bus": 1, "spi_mhz": 1}, "spi_mhz does not apply to bus 1"),
        (Adxl355Options, {"spi_mhz": 10.5}, "spi_mhz 10.5 is too fast: at most 10 for"),
        (Adxl345Options, {"spi_mhz": 2}, "spi_mhz 2 is too fast: at most 1.5 for"),
        (Mpu6050Options, {}, "this driver does not read over SPI ('spi0.0')"),
        (Adxl355Options, {"bus": "spidev0.0"}, "'spidev0.0' is no bus"),
        (Adxl355Options, {"bus": -1}, "'-1' is no bus"),
        # 4000 samples of 9 bytes, 500 polls of a first byte for each of three reads and three more: 39 kB/s of 8 bits
        (Adxl355Options, {"rate_hz": 4000, "spi_mhz": 0.4}, "are 312 kbit/s, 78% of spi_mhz 0.4; at most 70%"),
        (Adxl355Options, {"spi_mhz": 0.05}, "greater than or equal to 0.1"),
    ],
)
def test_options_that_cannot_be(options: Any, given: dict[str, Any], says: str) -> None:
    with pytest.raises(ValidationError) as refused:
        options(**{"bus": "spi0.0"} | given)
    assert says in str(refused.value)


def test_what_i2c_is_too_slow_for_goes_over_spi() -> None:
    with pytest.raises(ValidationError, match="bus too slow"):
        Adxl355Options(rate_hz=4000)
    options = Adxl355Options(rate_hz=4000, bus="spi0.0")
    assert (options.node, options.over_spi) == ("/dev/spidev0.0", True)


@pytest.mark.parametrize(("message_s", "highest"), [(0.1e-3, None), (2e-3, "500")])
def test_a_rate_that_the_messages_take_too_long_for_is_refused(message_s: float, highest: str | None) -> None:
    # Of 2 ms a message, as over USB, a poll has three. It comes each 8 samples: each 8 ms at 1000 Hz, 75 % of the time.
    now = Now()
    twin = Adxl355Twin(lambda _, n: np.ones((n, 3), np.int32), now.due(2000), now)
    with installed({NODE: SpiBus(twin, spend=now.sleep, message_s=message_s)}):
        options = Adxl355Options(bus="spi0.0", rate_hz=2000, spi_mhz=10)
        sensor = Adxl355("sensor", options, clock=now.clock, sleep=now.sleep)
        if highest is None:
            sensor.open()
        else:
            with pytest.raises(ConfigurationError, match=f"the highest rate_hz that can be read is {highest};"):
                sensor.open()
