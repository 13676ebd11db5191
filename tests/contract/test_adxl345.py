"""The driver contract on the ADXL345's twin, and the faults that only this part has."""

from __future__ import annotations

import errno
from collections.abc import Iterator

import numpy as np
import pytest

from agent.config.knowledge import Prior
from hw.adxl345 import Adxl345
from hw.block import BlockFlags, Drop
from hw.conformance.i2c import BUSES, I2cContract, I2cRig
from hw.virtual.adxl345_twin import Adxl345Twin


class Adxl345Rig(I2cRig):
    driver, twin_class, address, full = Adxl345, Adxl345Twin, 0x53, 4095
    rate_hz = 800.0
    fifo_register = 0x30  # reads start at INT_SOURCE, before the data

    def lose(self) -> None:
        # The samples carry no number, so the driver can notice a loss only as an interrupted read: simulate one.
        self.twin.break_off(errno.EIO, 3)


class TestAdxl345(I2cContract):
    adapters = BUSES
    filter_register = 0x2C, "BW_RATE"
    trimmed = {0x1E: 0x11, 0x20: 0xF0, 0x2E: 0xFF}  # noqa: RUF012 - offsets, interrupts
    late_s = 0.2
    temperature = None

    @pytest.fixture
    def rig(self) -> Iterator[Adxl345Rig]:
        rig = Adxl345Rig()
        yield rig
        rig.close()

    def test_says_who_it_is_and_how_it_is_set(self, rig: Adxl345Rig) -> None:
        info = rig.sensor.open()
        # Data sheet: 256 LSB/g in full resolution, 13 bits at 16 g.
        assert info.nominal_sensitivity == pytest.approx(256 / 9.80665, rel=1e-12)
        assert info.range_mps2 == pytest.approx(16 * 9.80665, rel=1e-12)
        assert info.settings["DATA_FORMAT"] == "0x0B"
        assert info.settings["FIFO_CTL"] == "0x80"
        assert rig.twin.registers[0x2D] == 0x08

    def test_self_test_left_on_is_taken_back(self, rig: Adxl345Rig) -> None:
        rig.twin.registers[0x31] = 0x80
        rig.sensor.open()
        assert rig.twin.registers[0x31] == 0x0B

    def test_samples_behind_an_overrun_are_dropped_and_counted(self, rig: Adxl345Rig) -> None:
        rig.sensor.open()
        rig.read()
        rig.sleep(0.2)
        rig.read()
        assert rig.sensor.take_drops() == [
            Drop(33 * 6, "bytes", "a full FIFO, which may have lost samples, or an interrupted FIFO read")
        ]

    @pytest.mark.parametrize(("waiting", "lost"), [(31, False), (32, True), (33, True)])
    def test_a_full_fifo_counts_as_a_loss(self, rig: Adxl345Rig, waiting: int, lost: bool) -> None:
        # Data sheets of the family: the overrun bit is set when the FIFO is filled; no sample is lost up to 33.
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep((waiting - 0.5) / rig.rate_hz + (-rig.t_s) % (1 / rig.rate_hz))
        assert rig.due(rig.t_s) - 1 - before[-1] == waiting
        flags, after = rig.read()
        assert flags == (BlockFlags.RESTART | BlockFlags.OVERRUN if lost else BlockFlags.NONE)
        assert (after[0] > before[-1] + waiting) if lost else after[0] == before[-1] + 1
        dropped = sum(drop.count for drop in rig.sensor.take_drops())
        assert dropped == (6 * waiting if lost else 0)

    def test_the_default_prior_contains_the_sensitivity_at_another_supply(self, rig: Adxl345Rig) -> None:
        # 265 LSB/g in x and y at 3.3 V, against the 256 LSB/g that the driver tells
        nominal = rig.sensor.open().nominal_sensitivity
        assert nominal is not None
        assert abs(265 / 9.80665 / nominal - 1) <= Prior().u_main_pct / 100

    def test_overrun_between_count_and_read(self, rig: Adxl345Rig) -> None:
        class Stalling(Adxl345Twin):
            stall_s = 0.0

            def _get(self, register: int) -> int:
                value = super()._get(register)
                if register == 0x39 and value >= 28:
                    rig.t_s, Stalling.stall_s = rig.t_s + Stalling.stall_s, 0.0
                return value

        rig.put(Stalling(rig.counts, rig.due, lambda: rig.t_s))
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.036)
        Stalling.stall_s = 0.02
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] > before[-1] + 30

    def test_overrun_within_a_transfer(self, rig: Adxl345Rig) -> None:
        # An adapter may stall between two messages of one transfer, for example an adapter on USB.
        class Stalling(Adxl345Twin):
            stall_s = 0.0

            def _read_fifo(self, count: int) -> bytes:
                data = super()._read_fifo(count)
                if len(self._fifo) == 6 * 5:
                    rig.t_s, Stalling.stall_s = rig.t_s + Stalling.stall_s, 0.0
                return data

        rig.put(Stalling(rig.counts, rig.due, lambda: rig.t_s))
        rig.sensor.open()
        _, before = rig.read()
        Stalling.stall_s = 0.05
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] > before[-1] + 1
        assert (np.diff(after) == 1).all()
