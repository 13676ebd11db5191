"""The contract on a pseudo-terminal under the real pyserial, and what only lines of text can do wrong."""

from __future__ import annotations

import fcntl
import os
import struct
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hw.block import BlockFlags, DeviceInfo, Drop
from hw.sensor import DeviceLost
from hw.serial_stream import SerialCsv, SerialCsvOptions
from hw.virtual.serial_port import PtyDevice, format_lines
from tests.contract.contract import Rig, SensorContract

KERNEL_BUFFER = 4095  # bytes a terminal holds for its reader


class SerialRig(Rig):
    rate_hz = 5000.0  # 50 lines a burst, so that the long test is not of system calls

    def __init__(self, link: Path, *, sequence: bool = True) -> None:
        self.saturated = range(0)
        self.next = 0
        self.sequence = sequence
        self.text = b""
        self.noise = b""  # what the device says instead of lines
        self.noise_bytes = 0
        self.port = PtyDevice(self.text_due, lambda: self.t_s, link)
        self.listener: int | None = None
        self.sensor = SerialCsv("sensor", self.options(), clock=self.clock, sleep=lambda s: self.sleep(s))

    def options(self, **changes: object) -> SerialCsvOptions:
        known = {"port": str(self.port.path), "rate_hz": self.rate_hz, "sequence": self.sequence, "full_scale": 1e9}
        return SerialCsvOptions.model_validate(known | changes)

    def build_elsewhere(self) -> SerialCsv:
        return SerialCsv("sensor", self.options(port="/dev/no-such-port"))

    def values(self, first: int, n: int) -> NDArray[np.float64]:
        k = np.arange(first, first + n, dtype=float)
        values = np.column_stack([k, -k, 0.5 * k])
        values[[i - first for i in self.saturated if first <= i < first + n], 1] = -1e9
        return values

    def text_due(self, t_s: float) -> bytes:
        if self.noise:
            self.noise_bytes += len(self.noise)
            self.next = self.due(t_s)
            self.text = self.noise
            return self.noise
        due = self.due(t_s)
        self.text = format_lines(self.values(self.next, due - self.next), "%.1f", self.next if self.sequence else None)
        self.next = due
        return self.text

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = indications.astype(float).T
        assert (z == 0.5 * x).all()
        assert ((y == -x) | ((y == -1e9) & np.isin(x, self.saturated))).all()
        return x.astype(np.int64)

    def sleep(self, seconds: float) -> None:
        """Time passes; the device writes what it made, as far as the terminal holds it, and it reaches the reader."""
        super().sleep(seconds)
        lost = self.port.lost_bytes
        waiting = self.waiting()
        self.port.serve()
        if not self.port.has_reader():
            return
        wanted = min(waiting + len(self.text) - (self.port.lost_bytes - lost), KERNEL_BUFFER)
        deadline = time.monotonic() + 5.0
        while self.waiting() < wanted and time.monotonic() < deadline:
            pass  # the kernel hands the bytes on from a worker of its own, within microseconds

    def waiting(self) -> int:
        """Bytes that wait for the reader, asked by a second file that never reads."""
        if self.listener is None:
            return 0
        try:
            return int(struct.unpack("I", fcntl.ioctl(self.listener, termios.FIONREAD, b"\0\0\0\0"))[0])
        except OSError:  # hung up
            return 0

    def open(self) -> DeviceInfo:
        """As a driver does it, and the device then ends the line within which that happened."""
        info = super().open()
        if self.listener is not None:
            os.close(self.listener)
        self.listener = os.open(self.port.path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        self.next = self.due(self.t_s)
        self.port.inject(b"\n")
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


class TestSerialCsv(SensorContract):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[SerialRig]:
        rig = SerialRig(tmp_path / "port")
        yield rig
        rig.close()

    def test_port_in_use(self, rig: SerialRig) -> None:
        rig.open()
        second = SerialCsv("second", rig.options())
        with pytest.raises(DeviceLost, match=f"port {rig.port.path}: .*exclusively lock"):
            second.open()
        rig.sensor.close()
        second.open()
        second.close()

    def test_a_file_is_no_port(self, rig: SerialRig, tmp_path: Path) -> None:
        file = tmp_path / "recording.csv"
        file.write_text("1,2,3\n")
        with pytest.raises(DeviceLost, match=f"port {file}: "):
            SerialCsv("sensor", rig.options(port=str(file))).open()

    @pytest.mark.parametrize(
        "garbage", [b"#c\n", b"1,2\n", b"\x00\xff\xfe\n", b"nan,nan,nan,nan\n", b"hello world, 3\r\n"]
    )
    def test_garbage_between_lines_costs_no_sample(self, rig: SerialRig, garbage: bytes) -> None:
        rig.open()
        before = list(rig.blocks(0.6))[-1]
        rig.port.inject(garbage * 3)
        block = next(rig.blocks(0.1))
        assert block.flags == BlockFlags.NONE
        assert rig.number(block.indications)[0] == rig.number(before.indications)[-1] + 1
        bad = [] if garbage.startswith(b"#") else [Drop(3, "lines", "not the expected decimals")]
        assert rig.sensor.take_drops() == bad
        assert rig.sensor.take_drops() == []

    def test_an_endless_line_is_counted_in_bytes_and_forgotten(self, rig: SerialRig) -> None:
        rig.open()
        next(rig.blocks(0.1))
        rig.noise = b"x" * 1000
        for _ in range(3):
            assert rig.sensor.read_block() is None
        noise = rig.noise_bytes
        assert noise > 100_000
        rig.noise = b""
        rig.port.inject(b"\n")
        next(rig.blocks(0.1))
        assert rig.sensor.take_drops() == [Drop(noise + 1, "bytes", "no newline within 256 bytes")]


class TestWithoutSequence:
    def test_a_bad_line_restarts_where_it_stood(self, tmp_path: Path) -> None:
        rig = SerialRig(tmp_path / "port", sequence=False)
        try:
            rig.open()
            *_, before = rig.blocks(0.6)
            rig.port.inject(b"1.0,2.0\n")
            after = next(rig.blocks(0.1))
            assert after.flags == BlockFlags.RESTART
            assert after.first_index == before.first_index + before.n
            assert rig.number(after.indications)[0] == rig.number(before.indications)[-1] + 1
        finally:
            rig.close()
