"""Registers of the LIS3DH and LIS2DH12 and the meaning of their contents.

Sources: data sheets LIS3DH (DocID17530) and LIS2DH12 (DocID025056); ST's lis3dh-pid (lis3dh_reg.h, lis3dh_reg.c) and
lis2dh12-pid; ST's STMems_Standard_C_drivers (lis3dh_self_test.c); Linux, drivers/iio/accel/st_accel_core.c (WHO_AM_I
0x33). They agree on registers, codes and mg per count. In the LIS2DH12 the registers of the third ADC are those of its
temperature, which is not read here. The 8-bit parts LIS3DE and LIS2DE12 have the same WHO_AM_I; their counts are
multiples of 16 here. What the sources do not agree on:

- 1 g at 2 g range: 1 mg per count in the data sheets, lis3dh-pid and Linux, thus 1000 counts; the examples in AN3308
  have 1024 counts (discussed in RIOT-OS pull request 2296). Used here: 1000. A calibration finds the true value.
- Rate code 8: 1600 Hz in Linux; 1620 Hz, in the 8-bit mode only, in lis3dh-pid. It is not used here.
- Rate code 9: 1250 Hz in revision 1 of the data sheet (Adafruit_LIS3DH issue 21), 1344 Hz in revision 2 and lis3dh-pid.
- OVRN_FIFO: "a slot was overwritten" in the data sheet; with 32 stored samples the level reads 31 and OVRN_FIFO is set
  (ruuvitag_fw issue 67). A full FIFO is therefore the same as an overrun here.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hw.fifo import FifoSamples, plain_samples
from hw.self_test import SelfTest

WHO_AM_I, IDENTITY = 0x0F, 0x33
AUTO_INCREMENT = 0x80  # added to a register's number; without it a read of several bytes repeats one register
TEMP_CFG_REG, CTRL_REG1, CTRL_REG4, CTRL_REG5, DATA, FIFO_CTRL_REG, FIFO_SRC_REG, ACT_THS = (
    *(0x1F, 0x20, 0x23, 0x24, 0x28, 0x2E, 0x2F, 0x3E),
)
BYPASS, STREAM = 0x00, 0x80  # FIFO_CTRL_REG
OVERRUN, LEVEL_MASK = 0x40, 0x1F  # in FIFO_SRC_REG
FIFO_SAMPLES = 32
SAMPLE_BYTES = 6
# High resolution, 12 bits. At 16 g a count is 12 mg, not 8 mg.
MG_PER_COUNT: Mapping[int, int] = {2: 1, 4: 2, 8: 4, 16: 12}
RATE_CODES: Mapping[float, int] = {1344.0: 9, 400.0: 7, 200.0: 6, 100.0: 5, 50.0: 4, 25.0: 3, 10.0: 2}
SETTLE_SAMPLES = 7  # data sheet: turn-on time of the 12-bit mode, 7 / rate
SELF_TEST_RANGE_G = 4  # at 2 g the largest change that is allowed and gravity together reach the end of the range
_ALL_AXES, _FIFO_ON, _BLOCK_DATA_UPDATE, _HIGH_RESOLUTION, _SELF_TEST_0 = 0x07, 0x40, 0x80, 0x08, 0x02


def limits(range_g: int) -> tuple[int, int]:
    """Lowest and highest count at `range_g`: the 12 bits, but at 16 g the specified range.

    There the 12 bits end at 24.6 g, and users see indications above 20 g (Adafruit_LIS3DH issue 47); the data sheet
    specifies 16 g.
    """
    last = 16_000 // MG_PER_COUNT[16]
    return (-last, last) if range_g == 16 else (-(2**11), 2**11 - 1)


def settings(rate_hz: float, range_g: int) -> dict[int, tuple[str, int]]:
    """Register -> (name, value) while measuring.

    High resolution, no high-pass filter, no self-test, no interrupts, temperature sensor and ADC off, FIFO in stream
    mode. With a threshold in ACT_THS the part would reduce its rate to 10 Hz while it is at rest.
    """
    controls = (f"CTRL_REG{number}" for number in range(1, 7))
    values = dict.fromkeys(enumerate(("TEMP_CFG_REG", *controls), TEMP_CFG_REG), 0)
    values[CTRL_REG1, "CTRL_REG1"] = RATE_CODES[rate_hz] << 4 | _ALL_AXES
    values[CTRL_REG4, "CTRL_REG4"] = _BLOCK_DATA_UPDATE | list(MG_PER_COUNT).index(range_g) << 4 | _HIGH_RESOLUTION
    values[CTRL_REG5, "CTRL_REG5"] = _FIFO_ON
    values[FIFO_CTRL_REG, "FIFO_CTRL_REG"] = STREAM
    values |= dict.fromkeys(enumerate(("ACT_THS", "ACT_DUR"), ACT_THS), 0)
    return {register: (name, value) for (register, name), value in values.items()}


def filters(rate_hz: float) -> tuple[str, ...]:
    """The filter at an output data rate, as in DeviceInfo.

    Data sheet, operating mode selection: in high resolution the bandwidth is a ninth of the output data rate. It tells
    no order: the standard uncertainty is so large that first and second order lie within U.
    """
    return (f"lowpass order=1 corner_hz={rate_hz / 9.0:g} u_corner_pct=50",)


def self_test(rate_hz: float, range_g: int) -> SelfTest:
    """Self-test 0 (positive).

    Data sheet and lis3dh_self_test.c: the size of the change is 17 to 360 counts of 4 mg at 2 g; no source tells its
    sign, so it must be the positive direction here. The noise is typically 3 mg rms at 100 Hz.
    """
    return SelfTest(
        writes=((CTRL_REG4, settings(rate_hz, range_g)[CTRL_REG4][1] | _SELF_TEST_0),),
        settle_s=0.1,
        low_g=(0.068, 0.068, 0.068),
        high_g=(1.44, 1.44, 1.44),
        noise_g=(0.003, 0.003, 0.003),
        source="LIS3DH data sheet, self-test output change",
    )


def samples(data: bytes) -> FifoSamples:
    """Samples of three 12-bit numbers, little-endian, at the upper end of 16 bits."""
    found = plain_samples(data, "<")
    return FifoSamples((found.counts >> 4).astype(np.int32), found.last, [], 0, b"")
