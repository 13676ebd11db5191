"""The driver contract on the LIS3DH's twin, its bytes, and the faults that only this part has."""

from __future__ import annotations

import errno
from collections.abc import Iterator

import numpy as np
import pytest

from hw import lis3dh_registers
from hw.block import BlockFlags, Drop
from hw.conformance.i2c import I2cContract, I2cRig
from hw.lis3dh import Lis3dh
from hw.sensor import ConfigurationError
from hw.virtual.lis3dh_twin import Lis3dhTwin


class Lis3dhRig(I2cRig):
    driver, twin_class, address, full = Lis3dh, Lis3dhTwin, 0x18, 2047
    rate_hz = 400.0
    fifo_register = 0xA8  # OUT_X_L and the bit that makes a read go on

    def lose(self) -> None:
        # The samples carry no number, so the driver can notice a loss only as an interrupted read: simulate one.
        self.twin.break_off(errno.EIO, 3)


class TestLis3dh(I2cContract):
    filter_register = 0x21, "CTRL_REG2"
    trimmed = {0x21: 0xFF, 0x22: 0xFF, 0x1F: 0xC0, 0x3E: 0x10}  # noqa: RUF012 - high-pass, interrupts, ADC, sleep
    late_s = 0.3
    temperature = None
    self_test_range = 2.0  # 4 g

    @pytest.fixture
    def rig(self) -> Iterator[Lis3dhRig]:
        rig = Lis3dhRig()
        yield rig
        rig.close()

    def test_says_who_it_is_and_how_it_is_set(self, rig: Lis3dhRig) -> None:
        info = rig.sensor.open()
        # Data sheet: 1 mg per count at 2 g in high resolution; the code of 400 Hz is 7; BDU and HR are set.
        assert info.nominal_sensitivity == pytest.approx(1000 / 9.80665, rel=1e-12)
        assert info.range_mps2 == pytest.approx(2.048 * 9.80665, rel=1e-12)
        assert (info.settings["CTRL_REG1"], info.settings["CTRL_REG4"]) == ("0x77", "0x88")
        assert (info.settings["CTRL_REG5"], info.settings["FIFO_CTRL_REG"]) == ("0x40", "0x80")

    def test_samples_of_a_full_fifo_are_dropped_and_counted(self, rig: Lis3dhRig) -> None:
        rig.sensor.open()
        rig.read()
        rig.sleep(0.3)
        rig.read()
        assert rig.sensor.take_drops() == [Drop(32 * 6, "bytes", "FIFO overrun or interrupted FIFO read")]

    def test_an_overrun_that_no_flag_tells(self, rig: Lis3dhRig) -> None:
        # 20 samples are stored when the level is read; the read begins so late that the first of them are overwritten.
        class Stalling(Lis3dhTwin):
            stall_s = 0.0

            def _get(self, register: int) -> int:
                value = super()._get(register)
                if register == 0x2F and 20 <= value < 32:
                    rig.t_s, Stalling.stall_s = rig.t_s + Stalling.stall_s, 0.0
                return value

        rig.put(Stalling(rig.counts, rig.due, lambda: rig.t_s))
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.05)
        Stalling.stall_s = 0.04
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] > before[-1] + 20
        assert (np.diff(after) == 1).all()

    @pytest.mark.slow
    def test_a_part_that_samples_faster_than_stated_loses_nothing_unnoticed(self, rig: Lis3dhRig) -> None:
        # 9 % faster; the process does not get the processor between level and data, for 0 to 80 ms.
        class Stalling(Lis3dhTwin):
            stall_s = 0.0

            def write(self, data: bytes) -> None:
                if data == bytes([rig.fifo_register]):
                    rig.t_s, Stalling.stall_s = rig.t_s + Stalling.stall_s, 0.0
                super().write(data)

        rig.rate_hz = 400.0 * 1.09
        rig.put(Stalling(rig.counts, rig.due, lambda: rig.t_s))
        rig.sensor.open()
        _, before = rig.read()
        lost = 0
        for Stalling.stall_s in np.linspace(0.0, 0.08, 161).tolist():
            flags, after = rig.read()
            assert (np.diff(after) == 1).all()
            assert after[0] == before[-1] + 1 or flags & BlockFlags.RESTART
            lost += after[0] != before[-1] + 1
            before = after
        assert 20 < lost < 100

    def test_a_part_that_does_not_go_on_to_the_next_register(self, rig: Lis3dhRig) -> None:
        # Without bit 7 of the register's number a read repeats one register: the read-back would compare nonsense.
        class Repeating(Lis3dhTwin):
            def _after(self, register: int) -> int:
                return register

        rig.put(Repeating(rig.counts, rig.due, lambda: rig.t_s))
        with pytest.raises(ConfigurationError, match="CTRL_REG1 is 0x00, not 0x77"):
            rig.sensor.open()

    def test_the_first_samples_after_the_start_are_not_used(self, rig: Lis3dhRig) -> None:
        # Data sheet: the 12-bit mode settles within 7 / rate.
        rig.sensor.open()
        _, numbers = rig.read()
        assert numbers[0] >= 7


# From the functions lis3dh_from_fs2_hr_to_mg, ..._fs4_..., ..._fs8_..., ..._fs16_hr_to_mg of ST's lis3dh_reg.c: the 16
# bits divided by 16, times 1, 2, 4 and 12 mg; and AN3308's example E0 15 = 350 mg at 2 g.
PAIRS = [
    ("0000", 2, 0, 0.0), ("1000", 2, 1, 0.001), ("f0ff", 2, -1, -0.001), ("f07f", 2, 2047, 2.047),
    ("0080", 2, -2048, -2.048), ("e015", 2, 350, 0.350), ("803e", 2, 1000, 1.0), ("80c1", 2, -1000, -1.0),
    ("0000", 4, 0, 0.0), ("f0ff", 4, -1, -0.002), ("f07f", 4, 2047, 4.094), ("0080", 4, -2048, -4.096),
    ("401f", 4, 500, 1.0), ("f0ff", 8, -1, -0.004), ("f07f", 8, 2047, 8.188), ("0080", 8, -2048, -8.192),
    ("a00f", 8, 250, 1.0), ("0000", 16, 0, 0.0), ("f0ff", 16, -1, -0.012), ("3005", 16, 83, 0.996),
    ("5053", 16, 1333, 15.996), ("f07f", 16, 2047, 24.564), ("0080", 16, -2048, -24.576),
]  # fmt: skip


@pytest.mark.parametrize(("data", "range_g", "counts", "g"), PAIRS)
def test_bytes_as_the_maker_reads_them(data: str, range_g: int, counts: int, g: float) -> None:
    found = lis3dh_registers.samples(bytes.fromhex(data * 3)).counts
    assert found.dtype == np.int32
    assert found.tolist() == [[counts] * 3]
    assert counts * lis3dh_registers.MG_PER_COUNT[range_g] / 1000 == pytest.approx(g, abs=1e-9)


@pytest.mark.parametrize(("range_g", "g"), [(2, 2.0), (4, 4.0), (8, 8.0), (16, 15.99)])
def test_a_range_is_what_the_data_sheet_specifies(range_g: int, g: float) -> None:
    low, high = lis3dh_registers.limits(range_g)
    mg = lis3dh_registers.MG_PER_COUNT[range_g]
    assert g <= high * mg / 1000 <= -low * mg / 1000 < 1.03 * range_g
