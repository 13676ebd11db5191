"""The driver contract on the ICM-42688-P's twin, its bytes, and the faults that only this part has."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hw import icm42688_registers
from hw.block import BlockFlags, Drop
from hw.conformance.i2c import I2cContract, I2cRig
from hw.icm42688 import Icm42688
from hw.sensor import DeviceLost, IdentityError
from hw.virtual.icm42688_twin import Icm42688Twin


class Icm42688Rig(I2cRig):
    driver, twin_class, address, full = Icm42688, Icm42688Twin, 0x68, 2**15 - 1

    def write_elsewhere(self, register: int, value: int) -> None:
        for pair in ((0x76, (register >> 8)), (register & 0xFF, value), (0x76, 0)):
            self.bus.transfer([(self.address, bytes(pair))])

    def lose(self) -> None:
        # The samples carry no number, so the driver can notice a loss only if the FIFO is out of step.
        self.twin._fill()
        del self.twin._fifo[21:24]


class TestIcm42688(I2cContract):
    filter_register = 0x204, "ACCEL_CONFIG_STATIC3"
    trimmed = {0x47B: 0x10, 0x47F: 0x22, 0x70: 0x78}  # noqa: RUF012 - offsets, self-test
    late_s = 0.4
    # Data sheet: raw / 132.48 + 25
    temperature = -1325, 14.99849
    self_test_range = 2.0  # 4 g

    @pytest.fixture
    def rig(self) -> Iterator[Icm42688Rig]:
        rig = Icm42688Rig()
        yield rig
        rig.close()

    def test_says_who_it_is_and_how_it_is_set(self, rig: Icm42688Rig) -> None:
        info = rig.sensor.open()
        # Data sheet: 16384 LSB/g at 2 g, code 3; 1 kHz is code 6; numbers below -32766 do not occur.
        assert info.nominal_sensitivity == pytest.approx(16384 / 9.80665, rel=1e-12)
        assert info.range_mps2 == pytest.approx(32766 / 16384 * 9.80665, rel=1e-12)
        assert (info.settings["ACCEL_CONFIG0"], info.settings["GYRO_CONFIG0"]) == ("0x66", "0x06")
        assert (info.settings["PWR_MGMT0"], info.settings["FIFO_CONFIG1"]) == ("0x0F", "0x41")
        assert rig.twin.registers[0x76] == 0

    @pytest.mark.parametrize("byte", [1, 3, 4, 7])
    def test_a_fifo_out_of_step_is_flushed(self, rig: Icm42688Rig, byte: int) -> None:
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.02)
        rig.twin._fill()
        del rig.twin._fifo[byte : byte + 3]
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] > before[-1] + 20
        (drop,) = rig.sensor.take_drops()
        assert drop.reason == "FIFO overrun or incomplete samples; FIFO was flushed"

    def test_a_count_that_is_fresh_at_the_first_read(self, rig: Icm42688Rig) -> None:
        # The other reading of the data sheet: FIFO_COUNTL latches the count and gives it at once.
        class Fresh(Icm42688Twin):
            def _get(self, register: int) -> int:
                if register == 0x2F:
                    super()._get(register)
                return super()._get(register)

        rig.put(Fresh(rig.counts, rig.due, lambda: rig.t_s))
        self.test_arrivals_are_late_by_less_than_a_sample(rig)

    def test_a_count_that_is_too_high_loses_nothing(self, rig: Icm42688Rig) -> None:
        class Boasting(Icm42688Twin):
            def _get(self, register: int) -> int:
                return super()._get(register) + (2 if register == 0x2F else 0)

        rig.put(Boasting(rig.counts, rig.due, lambda: rig.t_s))
        rig.sensor.open()
        _, before = rig.read()
        flags, after = rig.read()
        assert (flags, after[0]) == (BlockFlags.NONE, before[-1] + 1)
        assert rig.sensor.take_drops() == []

    def test_an_invalid_sample_is_dropped_where_it_is(self, rig: Icm42688Rig) -> None:
        rig.sensor.open()
        rig.read()
        rig.sleep(0.02)
        rig.twin._fill()
        rig.twin._fifo[17:23] = b"\x80\x00" * 3
        _, before = rig.read()
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART
        assert after[0] == before[-1] + 2
        assert rig.sensor.take_drops() == [Drop(8, "bytes", "incomplete samples in the FIFO")]

    @pytest.mark.parametrize("bank", [1, 2, 3, 4])
    def test_a_bank_that_another_program_selects_is_noticed(self, rig: Icm42688Rig, bank: int) -> None:
        rig.sensor.open()
        rig.read()
        rig.twin.registers[0x76] = bank
        before = bytes(rig.twin.registers)
        with pytest.raises(DeviceLost, match=r"REG_BANK_SEL is 0x0\d, not 0x00"):
            list(rig.blocks(2.0))
        assert bytes(rig.twin.registers[:0x2D]) == before[:0x2D]
        assert bytes(rig.twin.registers[0x77:]) == before[0x77:]

    def test_nothing_is_written_to_a_bank_that_another_program_selects(self, rig: Icm42688Rig) -> None:
        # It does so between count and data. The data are nonsense, but a flush would write to the other bank's 0x4B.
        class Switched(Icm42688Twin):
            armed = False

            def write(self, data: bytes) -> None:
                if data == b"\x30" and self.armed:
                    self.registers[0x76] = 1
                super().write(data)

        twin = Switched(rig.counts, rig.due, lambda: rig.t_s)
        rig.put(twin)
        rig.sensor.open()
        rig.read()
        before = bytes(twin.registers[0x100:])
        twin.armed = True
        with pytest.raises(DeviceLost, match="REG_BANK_SEL is 0x01, not 0x00"):
            list(rig.blocks(2.0))
        assert bytes(twin.registers[0x100:]) == before

    @pytest.mark.parametrize("bank", [1, 4])
    def test_a_bank_that_was_left_selected(self, rig: Icm42688Rig, bank: int) -> None:
        # Somebody was ended between two accesses: `open` puts it right, `identify` only tells it.
        rig.twin.registers[0x76] = bank
        with pytest.raises(IdentityError, match=rf"found 0x00 \(register bank {bank} is selected"):
            rig.build().identify()
        assert rig.twin.registers[0x76] == bank
        rig.sensor.open()
        assert rig.read()[0] == BlockFlags.RESTART


# Data sheet DS-000347, section 6.1: packet 1; section 3.2: 2048, 4096, 8192, 16384 LSB/g at 16, 8, 4, 2 g.
PAIRS = [
    ("0000", 2, 0, 0.0), ("0001", 2, 1, 1 / 16384), ("ffff", 2, -1, -1 / 16384), ("7fff", 2, 32767, 32767 / 16384),
    ("8002", 2, -32766, -32766 / 16384), ("4000", 2, 16384, 1.0), ("c000", 2, -16384, -1.0), ("2000", 4, 8192, 1.0),
    ("0000", 4, 0, 0.0), ("ffff", 4, -1, -1 / 8192), ("7fff", 4, 32767, 32767 / 8192),
    ("8002", 4, -32766, -32766 / 8192), ("e000", 4, -8192, -1.0), ("1000", 8, 4096, 1.0), ("ffff", 8, -1, -1 / 4096),
    ("7fff", 8, 32767, 32767 / 4096), ("8002", 8, -32766, -32766 / 4096), ("f000", 8, -4096, -1.0),
    ("0000", 16, 0, 0.0), ("0800", 16, 2048, 1.0), ("f800", 16, -2048, -1.0), ("ffff", 16, -1, -1 / 2048),
    ("7fff", 16, 32767, 32767 / 2048), ("8002", 16, -32766, -32766 / 2048),
]  # fmt: skip


@pytest.mark.parametrize(("data", "range_g", "counts", "g"), PAIRS)
@pytest.mark.parametrize("header", ["40", "42", "43"])  # 0100_00xx; the last two bits tell of a change of the rate
def test_bytes_as_the_data_sheet_lays_them_out(data: str, range_g: int, counts: int, g: float, header: str) -> None:
    found = icm42688_registers.samples(bytes.fromhex(header + 3 * data + "19"))
    assert found.counts.tolist() == [[counts] * 3]
    assert (found.breaks, found.dropped, found.counts.dtype) == ([], 0, np.int32)
    assert counts / icm42688_registers.COUNTS_PER_G[range_g] == pytest.approx(g, abs=1e-12)


@pytest.mark.parametrize(
    ("data", "counts", "breaks", "dropped"),
    [
        ("40 0001 0002 0003 00", [[1, 2, 3]], [], 0),
        ("40 8000 8000 8000 00", [], [0], 1),  # an invalid sample
        ("60 0001 0002 0003 00", [], [0], 1),  # a packet with the gyroscope has 16 bytes
        ("20 0001 0002 0003 00", [], [0], 1),  # a packet of the gyroscope
        ("40 0001 0002 0003 00 20 0000 0000 0000 00 40 0004 0005 0006 00", [[1, 2, 3], [4, 5, 6]], [1], 1),
    ],
)
def test_packets(data: str, counts: list[list[int]], breaks: list[int], dropped: int) -> None:
    found = icm42688_registers.samples(bytes.fromhex(data))
    assert (found.counts.tolist(), found.breaks, found.dropped) == (counts, breaks, dropped)


@pytest.mark.parametrize(
    ("data", "left", "in_step"),
    [
        ("ff ffff ffff ffff ff", "", True),  # the FIFO is empty
        ("40 0001 0002 0003 00 ff ffff ffff ffff ff", "40 0001 0002 0003 00", True),
        ("40 ffff ffff ffff ff", "40 ffff ffff ffff ff", True),
        ("ff ffff ffff ffff 40", "ff ffff ffff ffff 40", False),  # a packet that begins one byte late
        ("42 0001 0002 0003 00 fe 0201 0203 0400 40", "42 0001 0002 0003 00 fe 0201 0203 0400 40", False),
    ],
)
def test_an_empty_fifo_and_one_out_of_step(data: str, left: str, in_step: bool) -> None:
    found = icm42688_registers.without_empty(bytes.fromhex(data))
    assert (found, icm42688_registers.in_step(found)) == (bytes.fromhex(left), in_step)


@given(st.binary(max_size=8 * 40).map(lambda data: data[: len(data) // 8 * 8]))
def test_any_packets_decode(data: bytes) -> None:
    found = icm42688_registers.samples(data)
    assert len(found.counts) + found.dropped == len(data) // 8
    assert all(0 <= at <= len(found.counts) for at in found.breaks)


@pytest.mark.parametrize(("raw", "degc"), [("0000", 25.0), ("0cf0", 50.0), ("f310", 0.0), ("ffff", 24.99245)])
def test_temperature(raw: str, degc: float) -> None:
    assert icm42688_registers.temperature(bytes.fromhex(raw))[1] == pytest.approx(degc, abs=1e-5)


def test_self_test_limits_of_the_maker() -> None:
    # TDK's driver: 2620 * 1.01^(code - 1) counts at 2 g, 0.5 to 1.5 times that; without a code 50 to 1200 mg.
    test = icm42688_registers.self_test(bytes([1, 113, 0]), 1000.0)
    assert test.low_g == pytest.approx((0.5 * 2620 / 16384, 0.5 * 7985 / 16384, 0.05), rel=3e-4)
    assert test.high_g == pytest.approx((1.5 * 2620 / 16384, 1.5 * 7985 / 16384, 1.2), rel=3e-4)
