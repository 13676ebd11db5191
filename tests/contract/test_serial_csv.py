"""The driver contract on `serial-csv`, and the faults that only lines of text have."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.core.identity import nominal_of
from hw.block import BlockFlags, DeviceInfo, Drop
from hw.conformance.serial import SerialContract, SerialRig
from hw.serial_stream import SerialCsv
from hw.virtual.serial_port import format_lines


class CsvRig(SerialRig):
    driver = SerialCsv
    known = {"sequence": True, "full_scale": 1e9}  # noqa: RUF012
    rate_hz = 5000.0  # 50 lines per burst, so that system calls do not dominate the long test

    def write(self, first: int, n: int) -> bytes:
        return format_lines(self.values(first, n), "%.1f", first if self.known["sequence"] else None)

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


class TestSerialCsv(SerialContract):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[CsvRig]:
        rig = CsvRig(tmp_path / "port")
        yield rig
        rig.close()

    @pytest.mark.parametrize(
        "garbage", [b"#c\n", b"1,2\n", b"\x00\xff\xfe\n", b"nan,nan,nan,nan\n", b"hello world, 3\r\n"]
    )
    def test_garbage_between_lines_costs_no_sample(self, rig: CsvRig, garbage: bytes) -> None:
        rig.open()
        before = list(rig.blocks(0.6))[-1]
        rig.port.inject(garbage * 3)
        block = next(rig.blocks(0.1))
        assert block.flags == BlockFlags.NONE
        assert rig.number(block.indications)[0] == rig.number(before.indications)[-1] + 1
        bad = [] if garbage.startswith(b"#") else [Drop(3, "lines", "line without the expected decimal numbers")]
        assert rig.sensor.take_drops() == bad
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
