"""The contract of fieldcal applied to this driver, and byte pairs from the data sheet."""

from __future__ import annotations

import errno
from collections.abc import Iterator

import pytest
from fieldcal_lis3dh import Lis3dh
from lis3dh_twin import Lis3dhTwin

from hw.conformance.i2c import I2cContract, I2cRig
from hw.sensor import load_driver


class Lis3dhRig(I2cRig):
    driver, twin_class, address, full = Lis3dh, Lis3dhTwin, 0x18, 2047
    rate_hz = 400.0

    def lose(self) -> None:
        # The samples carry no number, so the driver can notice a loss only as an interrupted read: simulate one.
        self.twin.break_off(errno.EIO, 3)


class TestLis3dh(I2cContract):
    filter_register = 0x21, "CTRL_REG2"
    trimmed = {0x21: 0xFF, 0x22: 0xFF}  # noqa: RUF012 - high-pass filter, interrupts
    late_s = 0.3
    temperature = None
    samples = 50_000

    @pytest.fixture
    def rig(self) -> Iterator[Lis3dhRig]:
        rig = Lis3dhRig()
        yield rig
        rig.close()

    def test_says_how_it_is_set(self, rig: Lis3dhRig) -> None:
        info = rig.sensor.open()
        # Data sheet: 1 mg per count at 2 g in high resolution; the code of 400 Hz is 7.
        assert info.nominal_sensitivity == pytest.approx(1000 / 9.80665, rel=1e-12)
        assert info.settings["CTRL_REG1"] == "0x77"
        assert info.settings["CTRL_REG4"] == "0x88"


@pytest.mark.parametrize(("data", "counts"), [("1000 f0ff f07f", [1, -1, 2047]), ("0080 0040 0000", [-2048, 1024, 0])])
def test_left_justified_12_bits(data: str, counts: list[int]) -> None:
    sensor = Lis3dhRig.driver("sensor", Lis3dh.options_model())
    assert sensor._decode(bytes.fromhex(data)).counts.tolist() == [counts]


def test_fieldcal_finds_it_by_name() -> None:
    assert load_driver("lis3dh") is Lis3dh
