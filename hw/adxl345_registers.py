"""Registers of the ADXL345 and the meaning of their contents.

Source: data sheet ADXL345. Linux has the same names and bits (drivers/iio/accel/adxl345.h and adxl345_core.c).

OVERRUN: the data sheets of the family (ADXL312, ADXL313, ADXL344; a driver of the ADXL375 quotes the same) say that it
is set when the FIFO is filled, not when a sample is lost, and cleared when the FIFO is read. FIFO_STATUS counts up to
the full FIFO only, so nothing tells a full FIFO from one that lost samples.

Sensitivity: 256 LSB/g at a supply of 2.5 V; at 3.3 V, as on most boards, 265 LSB/g in x and y and 256 in z (Klipper,
pull request 5837; paparazzi, imu_ppzuav.h). The part does not tell its supply.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from hw.self_test import SelfTest
from hw.spi import SpiProtocol

IDENTITY = 0xE5
DEVID, BW_RATE, POWER_CTL, INT_SOURCE, DATA_FORMAT, DATA, FIFO_CTL, FIFO_STATUS = (
    *(0x00, 0x2C, 0x2D, 0x30, 0x31, 0x32, 0x38, 0x39),
)
OVERRUN = 0x01  # in INT_SOURCE
SAMPLE_BYTES = 8  # INT_SOURCE, DATA_FORMAT, three numbers
ENTRIES_MASK = 0x3F  # in FIFO_STATUS
FIFO_SAMPLES = 32
STANDBY, MEASURE = 0x00, 0x08
BYPASS, STREAM = 0x00, 0x80
# Mode 3: data sheet, serial communications. Bits: also Linux, drivers/iio/accel/adxl345_spi.c. The part takes 5 MHz,
# but needs 5 us between two reads of its FIFO. The same driver of Linux waits for them above 1.5 MHz; up to there they
# pass while the first byte is sent, so this driver reads no faster.
SPI = SpiProtocol(mode=3, highest_mhz=1.5, read=0x80, several=0x40)
COUNTS_PER_G = 256  # in full resolution, at any range; the data sheet allows 230 to 282 at 2.5 V
RANGE_CODES: Mapping[int, int] = {2: 0, 4: 1, 8: 2, 16: 3}
STATED_HZ_A_KHZ = 2.0  # data sheet: 800 Hz at 400 kHz, in proportion to the clock
# At 3200 and 1600 Hz the lowest bit is lost, and the samples do not fit a 400 kHz bus.
RATE_CODES: Mapping[float, int] = {800.0 / 2.0**step: 0x0D - step for step in range(10)}
LOWEST_STATED_HZ = 2.0  # of the rates whose filter is stated
SETTING_NAMES: Mapping[int, str] = {
    **dict(enumerate(("THRESH_TAP", "OFSX", "OFSY", "OFSZ", "DUR", "LATENT", "WINDOW", "THRESH_ACT"), 0x1D)),
    **dict(enumerate(("THRESH_INACT", "TIME_INACT", "ACT_INACT_CTL", "THRESH_FF", "TIME_FF", "TAP_AXES"), 0x25)),
    BW_RATE: "BW_RATE",
    POWER_CTL: "POWER_CTL",
    0x2E: "INT_ENABLE",
    0x2F: "INT_MAP",
    DATA_FORMAT: "DATA_FORMAT",
    FIFO_CTL: "FIFO_CTL",
}
_FULL_RESOLUTION, _SELF_TEST = 0x08, 0x80
_XY_AT_3V3, _Z_AT_3V3 = 1.77, 1.47  # change by the self-test at 3.3 V over that at 2.5 V


def limits(range_g: int) -> tuple[int, int]:
    """Lowest and highest count at `range_g`: 10 bits at 2 g, one bit more for each doubling of the range."""
    return -COUNTS_PER_G * range_g, COUNTS_PER_G * range_g - 1


def settings(rate_hz: float, range_g: int) -> dict[int, tuple[str, int]]:
    """Register -> (name, value) while measuring: offsets zero, no event detection, no self-test, FIFO in stream mode.

    The part has no reset command, so this sets every register that can be written.
    """
    values = dict.fromkeys(SETTING_NAMES, 0)
    values[BW_RATE] = RATE_CODES[rate_hz]
    values[POWER_CTL] = MEASURE
    values[DATA_FORMAT] = _FULL_RESOLUTION | RANGE_CODES[range_g]
    values[FIFO_CTL] = STREAM
    return {register: (SETTING_NAMES[register], value) for register, value in values.items()}


def filters(rate_hz: float) -> tuple[str, ...]:
    """The filter at an output data rate, as in DeviceInfo.

    Data sheet, table 1: the bandwidth (-3 dB) is half the output data rate. It tells no order: the standard uncertainty
    is so large that first and second order lie within U. Below 2 Hz nothing is stated: such a filter remembers longer
    than the windows can spare.
    """
    return (f"lowpass order=1 corner_hz={rate_hz / 2.0:g} u_corner_pct=50",) if rate_hz >= LOWEST_STATED_HZ else ()


def self_test(range_g: int) -> SelfTest:
    """Self-test with the SELF_TEST bit.

    Limits from the data sheet, tables 1 and 14: at 2.5 V supply 0.20 to 2.10 g in x, the same with opposite sign in y,
    0.30 to 3.40 g in z; at 3.3 V these values are multiplied by 1.77 (x, y) and 1.47 (z). The supply voltage is not
    known here, so the limits include both. They hold at 100 to 800 Hz (page 22). The noise is given in counts, at any
    rate. The power of the supply follows from the factors between 2.5 and 3.3 V.
    """
    return SelfTest(
        writes=((DATA_FORMAT, _SELF_TEST | _FULL_RESOLUTION | RANGE_CODES[range_g]),),
        settle_s=0.1,
        low_g=(0.20, -2.10 * _XY_AT_3V3, 0.30),
        high_g=(2.10 * _XY_AT_3V3, -0.20, 3.40 * _Z_AT_3V3),
        noise_g=(0.75 / COUNTS_PER_G, 0.75 / COUNTS_PER_G, 1.1 / COUNTS_PER_G),
        source="ADXL345 data sheet, self-test at 2.5 and 3.3 V, noise at 100 Hz",
        supply_exponent=(_power(_XY_AT_3V3), _power(_XY_AT_3V3), _power(_Z_AT_3V3)),
    )


def _power(factor: float) -> float:
    """The power of the supply with which something grows by `factor` from 2.5 to 3.3 V."""
    return math.log(factor) / math.log(3.3 / 2.5)
