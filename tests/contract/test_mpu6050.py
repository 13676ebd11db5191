"""The driver contract on the twins of the MPU-6050 and MPU-6500, and the faults that only their FIFO has."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from hw.block import BlockFlags
from hw.conformance.i2c import I2cContract, I2cRig
from hw.mpu6050 import Mpu6050
from hw.sensor import IdentityError
from hw.virtual.kernel import ADAPTERS
from hw.virtual.mpu6050_twin import TRIM, Mpu6050Twin, Mpu6500Twin


class Mpu6050Rig(I2cRig):
    driver, twin_class, address, full = Mpu6050, Mpu6050Twin, 0x68, 2**15 - 1


class Mpu6500Rig(Mpu6050Rig):
    twin_class = Mpu6500Twin


class TestMpu6050(I2cContract):
    filter_register = 0x1A, "CONFIG"
    trimmed = {0x1B: 0xE0, 0x6C: 0x3F}  # noqa: RUF012 - self-test, standby
    late_s = 0.4
    # Register map: raw / 340 + 36.53
    temperature = -3920, 25.0006
    self_test_range = 4.0  # 8 g

    @pytest.fixture
    def rig(self) -> Iterator[Mpu6050Rig]:
        rig = Mpu6050Rig()
        yield rig
        rig.close()

    def test_says_who_it_is_and_how_it_is_set(self, rig: Mpu6050Rig) -> None:
        info = rig.sensor.open()
        # Specification: 16384 LSB/g at 2 g.
        assert info.kind == "MPU-6050"
        assert info.nominal_sensitivity == pytest.approx(16384 / 9.80665, rel=1e-12)
        assert info.range_mps2 == pytest.approx(2 * 9.80665, rel=1e-12)
        assert info.settings["SMPLRT_DIV"] == "0x00"
        assert info.settings["CONFIG"] == "0x01"
        assert info.settings["PWR_MGMT_1"] == "0x01"
        # The factory trim is not a setting of the driver: it is recorded and not changed.
        assert [info.settings[f"ACCEL_OFFSET_{i}"] for i in range(6)] == [f"0x{value:02X}" for value in TRIM]
        assert bytes(rig.twin.registers[6:12]) == TRIM

    @pytest.mark.parametrize("byte", [1, 3, 100])
    def test_a_fifo_out_of_step_is_reset(self, rig: Mpu6050Rig, byte: int) -> None:
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.02)
        rig.twin.steal(byte, 1)
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] > before[-1] + 20
        (drop,) = rig.sensor.take_drops()
        assert drop.reason == "FIFO overrun or incomplete samples; FIFO was reset"

    def test_a_sample_that_is_just_being_written_is_no_fault(self, rig: Mpu6050Rig) -> None:
        class Writing(Mpu6050Twin):
            caught = 0

            def _get(self, register: int) -> int:
                value = super()._get(register)
                if register == 0x73 and value > 30 and not self.caught:
                    self.caught = 1
                    return value - 4
                return value

        twin = Writing(rig.counts, rig.due, lambda: rig.t_s)
        rig.put(twin)
        rig.sensor.open()
        numbers = []
        for expected in (BlockFlags.RESTART, BlockFlags.NONE):
            flags, number = rig.read()
            assert flags == expected
            numbers.append(number)
        assert twin.caught
        assert set(np.diff(np.concatenate(numbers)).tolist()) == {1}
        assert rig.sensor.take_drops() == []

    def test_an_unknown_part_is_taken_only_when_asked(self, rig: Mpu6050Rig) -> None:
        class Clone(Mpu6500Twin):
            identity = 0x98

        rig.put(Clone(rig.counts, rig.due, lambda: rig.t_s))
        with pytest.raises(IdentityError, match=r"WHO_AM_I is 0x98.*option clone"):
            rig.sensor.open()
        sensor = rig.build(clone=True)
        assert sensor.open().kind == "MPU clone 0x98"
        sensor.close()


class TestMpu6500(TestMpu6050):
    adapters = ADAPTERS[:2]  # the same driver as above
    trimmed = {0x1B: 0xE0, 0x6C: 0x3F}  # noqa: RUF012
    # Register map: raw / 333.87 + 21
    temperature = 3339, 31.00093
    self_test_range = 1.0  # AN-MPU-9250A-03: at 2 g

    @pytest.fixture
    def rig(self) -> Iterator[Mpu6050Rig]:
        rig = Mpu6500Rig()
        yield rig
        rig.close()

    def test_says_who_it_is_and_how_it_is_set(self, rig: Mpu6050Rig) -> None:
        info = rig.sensor.open()
        assert info.kind == "MPU-6500"
        assert info.settings["ACCEL_CONFIG_2"] == "0x01"
        assert bytes(rig.twin.registers[0x77:0x7D]) == TRIM

    def test_no_sample_is_lost_doubled_or_shifted(self, rig: Mpu6050Rig) -> None:  # type: ignore[override]
        """Done for one part only, because the parts differ only in identity, FIFO size and temperature."""
        rig.open()
        assert sum(block.n for block in rig.blocks(5.0)) >= 5000
        assert rig.sensor.take_drops() == []
