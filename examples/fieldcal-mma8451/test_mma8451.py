"""The contract of fieldcal applied to this driver, and byte pairs from the sources."""

from __future__ import annotations

import errno
from collections.abc import Iterator

import pytest
from fieldcal_mma8451 import Mma8451
from mma8451_twin import Mma8451Twin

from hw.conformance.i2c import I2cContract, I2cRig
from hw.sensor import load_driver


class Mma8451Rig(I2cRig):
    driver, twin_class, address, full = Mma8451, Mma8451Twin, 0x1C, 8191
    rate_hz = 400.0

    def lose(self) -> None:
        # The samples carry no number, so the driver can notice a loss only as an interrupted read: simulate one.
        self.twin.break_off(errno.EIO, 3)


class TestMma8451(I2cContract):
    filter_register = 0x0E, "XYZ_DATA_CFG"
    trimmed = {0x2F: 0x11, 0x31: 0xF0, 0x0E: 0x10}  # noqa: RUF012 - offsets, high-pass filter
    late_s = 0.3
    self_test_range = 2.0  # 4 g: gravity and the largest change that passes do not fit 2 g
    temperature = None
    samples = 50_000

    @pytest.fixture
    def rig(self) -> Iterator[Mma8451Rig]:
        rig = Mma8451Rig()
        yield rig
        rig.close()

    def test_says_how_it_is_set(self, rig: Mma8451Rig) -> None:
        info = rig.sensor.open()
        # Data sheet: 4096 counts per g at 2 g; the code of 400 Hz is 1.
        assert info.nominal_sensitivity == pytest.approx(4096 / 9.80665, rel=1e-12)
        assert info.settings["CTRL_REG1"] == "0x09"
        assert info.settings["CTRL_REG2"] == "0x02"


# Adafruit_MMA8451: the 16 bits shifted by 2; at 2 g 4096 counts are 1 g.
@pytest.mark.parametrize(
    ("data", "counts"), [("4000 fffc 7ffc", [4096, -1, 8191]), ("8000 c000 0000", [-8192, -4096, 0])]
)
def test_left_justified_14_bits(data: str, counts: list[int]) -> None:
    sensor = Mma8451Rig.driver("sensor", Mma8451.options_model())
    assert sensor._decode(bytes.fromhex(data)).counts.tolist() == [counts]


def test_fieldcal_finds_it_by_name() -> None:
    assert load_driver("mma8451") is Mma8451
