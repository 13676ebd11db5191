"""The driver contract on `serial-csv`, and the faults that only lines of text have."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError
from serial.tools.list_ports_common import ListPortInfo

from agent.core.identity import nominal_of
from hw.block import BlockFlags, DeviceInfo, Drop
from hw.conformance.serial import SerialContract, SerialRig
from hw.lines import DECIMAL_COMMAS, NAMED_NUMBERS, OTHER_COLUMNS, UNREADABLE
from hw.sensor import DeviceLost
from hw.serial_stream import SerialCsv, SerialCsvOptions
from hw.virtual.serial_port import format_lines


class CsvRig(SerialRig):
    driver = SerialCsv
    known = {"sequence": True, "full_scale": 1e9}  # noqa: RUF012
    rate_hz = 5000.0  # 50 lines per burst, so that system calls do not dominate the long test

    def write(self, first: int, n: int) -> bytes:
        return format_lines(self.values(first, n), "%.1f", first if self.known.get("sequence") else None)

    def values(self, first: int, n: int) -> NDArray[np.float64]:
        k = np.arange(first, first + n, dtype=float)
        values = np.column_stack([k, -k, 0.5 * k])
        values[[i - first for i in self.saturated if first <= i < first + n], 1] = -1e9
        return values

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = indications.astype(float).T
        assert (z == 0.5 * x).all()
        assert ((y == -x) | ((y == -1e9) & np.isin(x, self.saturated))).all()
        return x.astype(np.int64)

    def open(self) -> DeviceInfo:
        """Open the port; the device then finishes the line during which the port was opened."""
        info = super().open()
        self.port.inject(b"\n")
        return info


class UncountedRig(CsvRig):
    known = {"sequence": False, "full_scale": 1e9}  # noqa: RUF012


class TimedRig(CsvRig):
    """Lines with the device's time, blanks between the numbers, and CR alone at the end."""

    known = {"columns": ["micros", "x", "y", "z", "temperature"], "full_scale": 1e9}  # noqa: RUF012

    def write(self, first: int, n: int) -> bytes:
        times_us = (4_294_000_000 + 200 * np.arange(first, first + n)) % 2**32  # wraps after one second
        rows = np.column_stack([times_us, self.values(first, n), np.full(n, 23.5)])
        return format_lines(rows, "%.1f").replace(b",", b" ").replace(b"\n", b"\r")


class ByteCountedRig(CsvRig):
    """A counter of 8 bits, semicolons, one of them at the end of the line, and CRLF."""

    known = {"columns": ["seq", "x", "y", "z", "-"], "full_scale": 1e9}  # noqa: RUF012

    def write(self, first: int, n: int) -> bytes:
        rows = np.column_stack([np.arange(first, first + n) % 256, self.values(first, n)])
        return format_lines(rows, "%.1f").replace(b",", b";").replace(b"\n", b";ok;\r\n")


class TestTimed(SerialContract):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[TimedRig]:
        rig = TimedRig(tmp_path / "port")
        yield rig
        rig.close()

    def test_the_temperature_is_the_blocks(self, rig: TimedRig) -> None:
        rig.open()
        assert {block.temperature_degc for block in rig.blocks(1.2)} == {23.5}


class TestByteCounted(SerialContract):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[ByteCountedRig]:
        rig = ByteCountedRig(tmp_path / "port")
        yield rig
        rig.close()


class TestSerialCsv(SerialContract):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[CsvRig]:
        rig = CsvRig(tmp_path / "port")
        yield rig
        rig.close()

    @pytest.mark.parametrize(
        ("garbage", "reason"),
        [
            (b"#c\n", ""),
            (b"1,2\n", OTHER_COLUMNS),
            (b"\x00\xff\xfe\n", UNREADABLE),
            (b"nan,nan,nan,nan\n", UNREADABLE),
            (b"hello world, 3\r\n", UNREADABLE),
            (b"0,5;1,5;2,5\n", DECIMAL_COMMAS),
            (b"X:0.5,Y:1.5,Z:2.5\n", NAMED_NUMBERS),
        ],
    )
    def test_garbage_between_lines_costs_no_sample(self, rig: CsvRig, garbage: bytes, reason: str) -> None:
        rig.open()
        before = list(rig.blocks(0.6))[-1]
        rig.port.inject(garbage * 3)
        block = next(rig.blocks(0.1))
        assert block.flags == BlockFlags.NONE
        assert rig.number(block.indications)[0] == rig.number(before.indications)[-1] + 1
        assert rig.sensor.take_drops() == ([Drop(3, "lines", reason)] if reason else [])
        assert rig.sensor.take_drops() == []

    def test_an_endless_line_is_counted_in_bytes_and_forgotten(self, rig: CsvRig) -> None:
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


@pytest.mark.parametrize(("unit", "nominal"), [("g", 1 / 9.80665), ("m/s2", None), ("count", None)])
def test_a_unit_of_acceleration_tells_the_sensitivity(unit: str, nominal: float | None, tmp_path: Path) -> None:
    rig = CsvRig(tmp_path / "port")
    try:
        sensor = rig.build(unit=unit, filters=["flat"])
        info = sensor.open()
        assert (info.unit, info.nominal_sensitivity, info.filters) == (unit, nominal, ("flat",))
        assert nominal_of(asdict(info)) == {"g": nominal, "m/s2": 1.0, "count": None}[unit]
        sensor.close()
    finally:
        rig.close()


def test_a_port_that_is_gone_names_the_ports_that_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here, link = tmp_path / "ttyUSB1", tmp_path / "by-id" / "usb-Arduino_Uno_75830-if00"
    link.parent.mkdir()
    link.symlink_to(here)
    there = [ListPortInfo(str(here))]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: there)
    monkeypatch.setattr("hw.serial_ports.LINKS", tmp_path)
    rig = CsvRig(tmp_path / "port")
    try:
        gone = rig.build(port=str(tmp_path / "ttyUSB0"))
        with pytest.raises(DeviceLost) as lost:
            gone.open()
        told = f"port {tmp_path}/ttyUSB0: No such file or directory; serial ports that are there: {link} ({here})"
        assert str(lost.value) == told
        there.clear()
        with pytest.raises(DeviceLost, match="No such file or directory; no serial port is there"):
            gone.open()
    finally:
        rig.close()


def test_a_port_under_its_lasting_name_comes_back_under_another_number(tmp_path: Path) -> None:
    """The link of /dev/serial/by-id leads to ttyUSB1 after the device was ttyUSB0."""
    link = tmp_path / "usb-Arduino_Uno_75830-if00"
    rig = CsvRig(tmp_path / "ttyUSB0")
    link.symlink_to(rig.port.path)
    rig.sensor = rig.build(port=str(link))
    try:
        rig.open()
        next(rig.blocks(0.1))
        rig.unplug()
        with pytest.raises(DeviceLost):
            list(rig.blocks(2.0))
        rig.port.path = tmp_path / "ttyUSB1"
        rig.replug()
        link.unlink()
        link.symlink_to(rig.port.path)
        rig.open()
        assert next(rig.blocks(0.1)).flags == BlockFlags.RESTART
    finally:
        rig.close()


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({}, "x,y,z"),
        ({"sequence": True}, "seq,x,y,z"),
        ({"axes": 1, "sequence": True}, "seq,a"),
        ({"columns": ["a"]}, "a"),
        ({"columns": ["-", "seq", "x", "y", "z", "-"]}, "-,seq,x,y,z,-"),
        ({"columns": ["z", "y", "x"], "axes": 3, "sequence": False}, "z,y,x"),
    ],
)
def test_the_columns_of_a_line(options: dict[str, Any], line: str) -> None:
    read = SerialCsvOptions.model_validate({"port": "p", "rate_hz": 100} | options)
    assert ",".join(read.line) == line
    assert (read.axes, read.sequence) == (1 if line.endswith("a") else 3, "seq" in line)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"columns": ["x", "y"]}, "x, y and z are needed"),
        ({"columns": ["x", "y", "z", "a"]}, "x, y and z are needed"),
        ({"columns": ["x", "y", "z", "z"]}, "z is there twice"),
        ({"columns": ["seq", "a"], "axes": 3}, "1 axes and a seq, but axes = 3 and sequence = true"),
        ({"columns": ["x", "y", "z"], "sequence": True}, "3 axes and no seq, but axes = 3 and sequence = true"),
        ({"columns": ["time", "x", "y", "z"]}, "Input should be 'seq'"),
        ({"columns": "x,y,z"}, "tuple"),
        ({"columns": ["-"] * 17}, "at most 16"),
        ({"columns": [[], "x", "y", "z"]}, "Input should be 'seq'"),
    ],
)
def test_columns_that_make_no_line(options: dict[str, Any], told: str) -> None:
    with pytest.raises(ValidationError, match=told):
        SerialCsvOptions.model_validate({"port": "p", "rate_hz": 100} | options)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"rate_hz": 100, "columns": ["millis", "x", "y", "z"]}, None),
        ({"rate_hz": 500, "columns": ["millis", "x", "y", "z"]}, "millis does not tell one missing sample at"),
        ({"rate_hz": 500, "columns": ["seq", "millis", "x", "y", "z"]}, None),
        # `1,1,1` and its newline are 6 bytes of 10 bits.
        ({"rate_hz": 160, "baud_rate": 9600}, None),
        (
            {"rate_hz": 161, "baud_rate": 9600},
            "161 lines/s of 3 numbers are at least 9660 bit/s, baud_rate is 9600",
        ),
    ],
)
def test_advice(options: dict[str, Any], told: str | None) -> None:
    advice = SerialCsvOptions.model_validate({"port": "p"} | options).advice
    assert len(advice) == (told is not None)
    assert told is None or told in advice[0]


def test_a_file_is_no_port(tmp_path: Path) -> None:
    path = tmp_path / "port"
    path.write_text("0.1,0.2,9.8\n")
    sensor = SerialCsv("imu", SerialCsvOptions(port=str(path), rate_hz=100.0))
    with pytest.raises(DeviceLost, match=f"port {path}: it is no serial port; state one that is"):
        sensor.open()


def test_a_device_with_new_columns_is_another_one_and_the_old_options_make_the_old_identity(tmp_path: Path) -> None:
    rig = CsvRig(tmp_path / "port")
    try:
        settings = [
            rig.build(**options).open().settings
            for options in ({"sequence": True}, {"sequence": True, "columns": ["x", "y", "z", "seq"]})
        ]
    finally:
        rig.close()
    port = {"port": str(tmp_path / "port"), "baud_rate": "115200", "sequence": "True"}
    assert settings == [port, port | {"columns": "x,y,z,seq"}]


class TestWithoutSequence:
    def test_a_bad_line_restarts_where_it_stood(self, tmp_path: Path) -> None:
        rig = UncountedRig(tmp_path / "port")
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
