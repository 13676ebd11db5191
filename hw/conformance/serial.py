"""Tests that every driver on a serial port must pass, on a pseudo-terminal under the real pyserial."""

from __future__ import annotations

import fcntl
import os
import struct
import termios
import time
from abc import abstractmethod
from pathlib import Path
from typing import Any, ClassVar

import pytest

from hw.block import DeviceInfo
from hw.conformance.sensor import Rig, SensorContract
from hw.sensor import DeviceLost
from hw.serial_sensor import SerialSensor
from hw.virtual.serial_port import PtyDevice

KERNEL_BUFFER = 4095  # bytes that a terminal keeps for its reader


class SerialRig(Rig):
    """Rig for a driver on a serial port.

    A subclass names the driver, its options, and the bytes that the device writes.
    """

    driver: ClassVar[type[SerialSensor]]
    known: ClassVar[dict[str, Any]]

    def __init__(self, link: Path) -> None:
        self.saturated = range(0)
        self.next = 0
        self.text = b""
        self.noise = b""  # bytes that the device writes instead of its samples
        self.noise_bytes = 0
        self.port = PtyDevice(self.text_due, lambda: self.t_s, link, self.received)
        self.listener: int | None = None
        self.sensor = self.build()

    @abstractmethod
    def write(self, first: int, n: int) -> bytes:
        """Bytes that the device writes for samples first .. first + n - 1."""

    def received(self, data: bytes) -> None:
        """Handle bytes that the driver sent to the device."""

    def build(self, **changes: Any) -> SerialSensor:
        options = {"port": str(self.port.path), "rate_hz": self.rate_hz} | self.known | changes
        model = self.driver.options_model
        return self.driver("sensor", model.model_validate(options), clock=self.clock, sleep=lambda s: self.sleep(s))

    def build_elsewhere(self) -> SerialSensor:
        return self.build(port="/dev/no-such-port")

    def text_due(self, t_s: float) -> bytes:
        due = self.due(t_s)
        if self.noise:
            self.noise_bytes += len(self.noise)
            self.text = self.noise
        else:
            self.text = self.write(self.next, due - self.next)
        self.next = due
        return self.text

    def sleep(self, seconds: float) -> None:
        """Move the clock; the device writes its new samples, as far as the terminal has room, to the reader."""
        super().sleep(seconds)
        lost = self.port.lost_bytes
        waiting = self.waiting()
        self.port.serve()
        if self.listener is None or not self.port.has_reader():
            return
        wanted = min(waiting + len(self.text) - (self.port.lost_bytes - lost), KERNEL_BUFFER)
        deadline = time.monotonic() + 5.0
        while self.waiting() < wanted and time.monotonic() < deadline:
            pass  # the kernel passes the bytes on from its own worker thread, within microseconds

    def waiting(self) -> int:
        """Number of bytes that wait for the reader, asked through a second file that never reads."""
        if self.listener is None:
            return 0
        try:
            return int(struct.unpack("I", fcntl.ioctl(self.listener, termios.FIONREAD, b"\0\0\0\0"))[0])
        except OSError:  # the port is unplugged
            return 0

    def open(self) -> DeviceInfo:
        """Open the port like the driver does; the device goes on from its present sample."""
        if self.listener is not None:
            os.close(self.listener)
            self.listener = None
        info = super().open()
        self.listener = os.open(self.port.path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        self.next = self.due(self.t_s)
        return info

    def saturate(self, first: int, last: int) -> None:
        self.saturated = range(first, last + 1)

    def lose(self) -> None:
        self.next += 3

    def unplug(self) -> None:
        self.port.unplug()

    def replug(self) -> None:
        self.port.replug()

    def close(self) -> None:
        self.sensor.close()
        if self.listener is not None:
            os.close(self.listener)
        self.port.stop()


class SerialContract(SensorContract):
    def test_port_in_use(self, rig: SerialRig) -> None:
        rig.open()
        second = rig.build()
        with pytest.raises(DeviceLost, match=f"port {rig.port.path}: another program has locked it"):
            second.open()

    def test_a_file_is_no_port(self, rig: SerialRig, tmp_path: Path) -> None:
        file = tmp_path / "recording.csv"
        file.write_text("1,2,3\n")
        with pytest.raises(DeviceLost, match=f"port {file}: "):
            rig.build(port=str(file)).open()
