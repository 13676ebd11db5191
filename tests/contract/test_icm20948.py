"""The driver contract on the ICM-20948's twin, its bytes, and the faults that only this part has."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hw import icm20948_registers
from hw.block import BlockFlags
from hw.conformance.i2c import I2cContract, I2cRig
from hw.fifo import plain_samples
from hw.icm20948 import Icm20948
from hw.sensor import DeviceLost, IdentityError
from hw.virtual.icm20948_twin import TRIM, Icm20948Twin


class Icm20948Rig(I2cRig):
    driver, twin_class, address, full = Icm20948, Icm20948Twin, 0x68, 2**15 - 1
    rate_hz = 1125.0

    def write_elsewhere(self, register: int, value: int) -> None:
        for pair in ((0x7F, 16 * (register >> 8)), (register & 0xFF, value), (0x7F, 0)):
            self.bus.transfer([(self.address, bytes(pair))])


class TestIcm20948(I2cContract):
    filter_register = 0x214, "ACCEL_CONFIG"
    trimmed = {0x215: 0x1C, 0x66: 0x0F, 0x210: 0x07}  # noqa: RUF012 - self-test, other sensors in the FIFO, rate
    late_s = 0.4
    # Data sheet: raw / 333.87 + 21
    temperature = 3339, 31.00093
    self_test_range = 2.0  # 4 g

    @pytest.fixture
    def rig(self) -> Iterator[Icm20948Rig]:
        rig = Icm20948Rig()
        yield rig
        rig.close()

    def test_says_who_it_is_and_how_it_is_set(self, rig: Icm20948Rig) -> None:
        info = rig.sensor.open()
        # Data sheet: 16384 LSB/g at 2 g, code 0; filter code 7; ACCEL_FCHOICE. Klipper: FIFO_EN_2 10, PWR_MGMT_2 07.
        assert info.nominal_sensitivity == pytest.approx(16384 / 9.80665, rel=1e-12)
        assert info.range_mps2 == pytest.approx(2 * 9.80665, rel=1e-12)
        assert (info.settings["ACCEL_CONFIG"], info.settings["ACCEL_SMPLRT_DIV_2"]) == ("0x39", "0x00")
        assert (info.settings["FIFO_EN_2"], info.settings["PWR_MGMT_2"]) == ("0x10", "0x07")
        assert rig.twin.registers[0x7F] == 0
        # The factory trim is not a setting of the driver: it is recorded and not changed.
        assert (info.settings["XA_OFFS_H"], info.settings["ZA_OFFS_L"]) == ("0x12", "0xBC")
        assert bytes(rig.twin.registers[0x114:0x11C]) == TRIM

    @pytest.mark.parametrize("byte", [1, 3, 100])
    def test_a_fifo_out_of_step_is_reset(self, rig: Icm20948Rig, byte: int) -> None:
        rig.sensor.open()
        _, before = rig.read()
        rig.sleep(0.02)
        rig.twin.steal(byte, 1)
        flags, after = rig.read()
        assert flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after[0] > before[-1] + 20
        (drop,) = rig.sensor.take_drops()
        assert drop.reason == "FIFO overrun or incomplete samples; FIFO was reset"

    @pytest.mark.parametrize("bank", [1, 2, 3])
    @pytest.mark.parametrize("register", [0x70, 0x72, 0x1B])  # before the count, the data, the overflow flag
    def test_a_bank_that_another_program_selects_is_noticed(self, rig: Icm20948Rig, bank: int, register: int) -> None:
        class Switched(Icm20948Twin):
            armed = False

            def write(self, data: bytes) -> None:
                if data == bytes([register]) and self.armed:
                    self.registers[0x7F] = bank << 4
                super().write(data)

            def _set(self, register: int, value: int) -> None:
                assert not (self.armed and register > 0xFF), f"0x{value:02X} was written to 0x{register:03X}"
                super()._set(register, value)

        twin = Switched(rig.counts, rig.due, lambda: rig.t_s)
        rig.put(twin)
        rig.sensor.open()
        rig.read()
        twin.armed = True
        with pytest.raises(DeviceLost, match=rf"REG_BANK_SEL is 0x{bank}0, not 0x00"):
            [rig.number(block.indications) for block in rig.blocks(2.0)]  # each checks that no sample is nonsense

    @pytest.mark.parametrize("bank", [1, 2, 3])
    def test_a_bank_that_was_left_selected(self, rig: Icm20948Rig, bank: int) -> None:
        # Somebody was ended between two accesses (SparkFun's library, issue 71): `open` puts it right, `identify` tells
        # it and writes nothing.
        rig.twin.registers[0x7F] = bank << 4
        with pytest.raises(IdentityError, match=rf"found 0x00 \(register bank {bank} is selected"):
            rig.build().identify()
        assert rig.twin.registers[0x7F] == bank << 4
        rig.sensor.open()
        assert rig.read()[0] == BlockFlags.RESTART

    @pytest.mark.parametrize("value", [0x01, 0x40, 0x11, 0xFF])
    def test_a_register_that_selects_no_bank_is_left_alone(self, rig: Icm20948Rig, value: int) -> None:
        # Another device at the address: a clock, say.
        class Clock(Icm20948Twin):
            def _get(self, register: int) -> int:  # noqa: ARG002 - it answers the same everywhere
                return value

            def _set(self, register: int, value: int) -> None:
                raise AssertionError(f"0x{value:02X} was written to 0x{register:02X}")

        rig.put(Clock(rig.counts, rig.due, lambda: rig.t_s))
        with pytest.raises(IdentityError):
            rig.sensor.open()

    def test_an_mpu_6500_whose_factory_value_is_the_identity(self, rig: Icm20948Rig) -> None:
        rig.twin.registers[0x75] = 0x70
        with pytest.raises(IdentityError, match="WHO_AM_I is 0x70, this is an MPU-6500: use mpu6050"):
            rig.sensor.open()


# Data sheet DS-000189, section 3.2: 16384, 8192, 4096, 2048 LSB/g at 2, 4, 8, 16 g; two's complement, big-endian as in
# SparkFun's library (ICM_20948_get_agmt). Klipper: 1/4096 g at 8 g.
PAIRS = [
    ("0000", 2, 0, 0.0), ("0001", 2, 1, 1 / 16384), ("ffff", 2, -1, -1 / 16384), ("7fff", 2, 32767, 32767 / 16384),
    ("8000", 2, -32768, -2.0), ("4000", 2, 16384, 1.0), ("c000", 2, -16384, -1.0), ("0000", 4, 0, 0.0),
    ("2000", 4, 8192, 1.0), ("ffff", 4, -1, -1 / 8192), ("7fff", 4, 32767, 32767 / 8192), ("8000", 4, -32768, -4.0),
    ("e000", 4, -8192, -1.0), ("1000", 8, 4096, 1.0), ("ffff", 8, -1, -1 / 4096), ("7fff", 8, 32767, 32767 / 4096),
    ("8000", 8, -32768, -8.0), ("f000", 8, -4096, -1.0), ("0000", 16, 0, 0.0), ("0800", 16, 2048, 1.0),
    ("f800", 16, -2048, -1.0), ("ffff", 16, -1, -1 / 2048), ("7fff", 16, 32767, 32767 / 2048),
    ("8000", 16, -32768, -16.0),
]  # fmt: skip


@pytest.mark.parametrize(("data", "range_g", "counts", "g"), PAIRS)
def test_bytes_as_the_sources_read_them(data: str, range_g: int, counts: int, g: float) -> None:
    assert plain_samples(bytes.fromhex(3 * data), ">").counts.tolist() == [[counts] * 3]
    assert counts / icm20948_registers.COUNTS_PER_G[range_g] == pytest.approx(g, abs=1e-12)


@pytest.mark.parametrize(
    ("rate_hz", "range_g", "divider", "accel_config"),
    [(1125.0, 2, (0, 0), 0x39), (562.5, 4, (0, 1), 0x0B), (225.0, 8, (0, 4), 0x15), (11.25, 16, (0, 99), 0x37)],
)
def test_settings(rate_hz: float, range_g: int, divider: tuple[int, int], accel_config: int) -> None:
    # Data sheet: 1125 Hz / (1 + divider); bits 5:3 filter, 2:1 range, 0 filter on. SparkFun: 473, 246, 111.4, 5.7 Hz
    found = dict(icm20948_registers.settings(rate_hz, range_g).values())
    assert (found["ACCEL_SMPLRT_DIV_1"], found["ACCEL_SMPLRT_DIV_2"]) == divider
    assert found["ACCEL_CONFIG"] == accel_config


@pytest.mark.parametrize(("raw", "degc"), [("0000", 21.0), ("0538", 25.00156), ("ffff", 20.997)])
def test_temperature(raw: str, degc: float) -> None:
    assert icm20948_registers.temperature(bytes.fromhex(raw))[1] == pytest.approx(degc, abs=1e-3)


def test_self_test_limits_of_the_maker() -> None:
    # InvenSense's inv_mpu: entries 1, 2 and 256 - 1 of its table are 2620, 2646 and 32804 counts at 2 g.
    test = icm20948_registers.self_test(bytes([1, 2, 255]), 1125.0)
    assert test.low_g == pytest.approx([0.5 * counts / 16384 for counts in (2620, 2646, 32804)], rel=3e-4)
    assert test.high_g == pytest.approx([1.5 * counts / 16384 for counts in (2620, 2646, 32804)], rel=3e-4)
    assert icm20948_registers.self_test(bytes(3), 1125.0).low_g == (0.225, 0.225, 0.225)
