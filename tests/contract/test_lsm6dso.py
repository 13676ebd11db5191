"""The driver contract on the LSM6DSO's twin, and the faults that only its tagged FIFO has."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from hw.block import BlockFlags, Drop
from hw.conformance.i2c import BUSES, I2cContract, I2cRig
from hw.lsm6dso import Lsm6dso
from hw.virtual.lsm6dso_twin import Lsm6dsoTwin, words

FREQ_FINE = -7


class Slow(Lsm6dsoTwin):
    freq_fine = FREQ_FINE


class Lsm6dsoRig(I2cRig):
    driver, twin_class, address, full = Lsm6dso, Slow, 0x6A, 2**15 - 1
    # AN5272: 6667 Hz (1 + 0.0015 FREQ_FINE) / 8
    rate_hz = 6667.0 * (1 - 0.0105) / 8


class TestLsm6dso(I2cContract):
    adapters = BUSES
    filter_register = 0x17, "CTRL8_XL"
    trimmed = {0x73: 0x11, 0x75: 0xF0, 0x14: 0x01, 0x17: 0xF4}  # noqa: RUF012 - offsets, self-test, high-pass filter
    late_s = 0.9
    self_test_range = 2.0  # 4 g: gravity and 1.7 g, the largest change that passes, do not fit 2 g
    # Data sheet: 256 LSB per degC, 0 at 25 degC.
    temperature = -2560, 15.0

    @pytest.fixture
    def rig(self) -> Iterator[Lsm6dsoRig]:
        rig = Lsm6dsoRig()
        yield rig
        rig.close()

    def test_says_who_it_is_and_how_it_is_set(self, rig: Lsm6dsoRig) -> None:
        info = rig.sensor.open()
        # Data sheet: 0.061 mg/LSB at 2 g.
        assert info.nominal_sensitivity == pytest.approx(1 / (0.061e-3 * 9.80665), rel=1e-12)
        assert info.nominal_rate_hz == pytest.approx(824.62, abs=0.01)
        assert info.settings["INTERNAL_FREQ_FINE"] == "0xF9"
        assert info.settings["CTRL1_XL"] == "0x70"
        assert info.settings["FIFO_CTRL3"] == "0x07"
        assert info.settings["FIFO_CTRL4"] == "0x06"

    def test_a_self_test_that_is_too_strong_fails(self, rig: Lsm6dsoRig) -> None:
        # 1 g of gravity and a change of 2 g in z: at 2 g the indication would change by 1 g and pass.
        mg = {0: 0.061, 1: 0.488, 2: 0.122, 3: 0.244}  # data sheet, by the code of the range

        def g() -> int:
            return round(1000 / mg[rig.twin.registers[0x10] >> 2 & 3])

        class Strong(Slow):
            def _deflection(self) -> NDArray[np.int32]:
                return np.array([0, 0, 2 * g() * (self.registers[0x14] & 1)], np.int32)

            def _encode(self, first: int, counts: NDArray[np.int32]) -> bytes:
                return super()._encode(first, np.clip(counts, -(2**15), 2**15 - 1))

        def gravity(first: int, n: int) -> NDArray[np.int32]:
            return np.array([0, 0, g()], np.int32) + np.arange(first, first + n, dtype=np.int32)[:, None] % 2

        rig.put(Strong(gravity, rig.due, lambda: rig.t_s))
        rig.sensor.open()
        report = rig.sensor.self_test()
        assert report.change_g[2] == pytest.approx(2.0, abs=1e-3)
        assert "z changes by 2.000 g, the limits are 0.05 to 1.7 g" in report.faults
        assert rig.sensor.open().range_mps2 == pytest.approx(2 * 9.80665, rel=1e-3)

    @pytest.mark.parametrize("lost", [1, 2, 3])
    def test_lost_words_show_by_the_counter(self, rig: Lsm6dsoRig, lost: int) -> None:
        rig.sensor.open()
        rig.read()
        rig.sleep(0.02)
        rig.twin.steal(3, lost)
        _, before = rig.read()
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART
        assert len(before) == 3
        assert after[0] == before[-1] + 1 + lost
        assert rig.sensor.take_drops() == []

    def test_lost_words_show_between_blocks_too(self, rig: Lsm6dsoRig) -> None:
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.02)
        rig.twin.steal(0, 2)
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART
        assert after[0] == before[-1] + 3

    @pytest.mark.parametrize("tag", [1, 3, 4, 5])
    def test_words_of_other_sensors_are_left_out(self, rig: Lsm6dsoRig, tag: int) -> None:
        rig.sensor.open()
        rig.read()
        rig.sleep(0.02)
        rig.twin._fill()
        rig.twin._fifo[21:21] = words(tag, 0, np.ones((1, 3), np.int32))
        flags, numbers = rig.read()
        assert flags == BlockFlags.NONE
        assert (np.diff(numbers) == 1).all()
        assert rig.sensor.take_drops() == [Drop(7, "bytes", "incomplete samples in the FIFO")]

    def test_a_tag_of_odd_parity_is_no_sample(self, rig: Lsm6dsoRig) -> None:
        rig.sensor.open()
        rig.read()
        rig.sleep(0.02)
        rig.twin._fill()
        rig.twin._fifo[14] ^= 1
        _, before = rig.read()
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART
        assert after[0] == before[-1] + 2
        assert rig.sensor.take_drops() == [Drop(7, "bytes", "incomplete samples in the FIFO")]
