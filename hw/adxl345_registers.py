"""Registers of the ADXL345 and what its bytes mean. Source: data sheet ADXL345; names and bits also in Linux,
drivers/iio/accel/adxl345.h and adxl345_core.c."""

from __future__ import annotations

from collections.abc import Mapping

from hw.self_test import SelfTest

IDENTITY = 0xE5
DEVID, BW_RATE, POWER_CTL, INT_SOURCE, DATA_FORMAT, DATA, FIFO_CTL, FIFO_STATUS = (
    *(0x00, 0x2C, 0x2D, 0x30, 0x31, 0x32, 0x38, 0x39),
)
OVERRUN = 0x01  # in INT_SOURCE; reading data clears it
SAMPLE_BYTES = 8  # INT_SOURCE, DATA_FORMAT, three numbers
ENTRIES_MASK = 0x3F  # in FIFO_STATUS
FIFO_SAMPLES = 32
STANDBY, MEASURE = 0x00, 0x08
BYPASS, STREAM = 0x00, 0x80
COUNTS_PER_G = 256  # full resolution, any range; data sheet: 230 to 282
RANGE_CODES: Mapping[int, int] = {2: 0, 4: 1, 8: 2, 16: 3}
# 3200 and 1600 Hz lose their lowest bit and do not fit a 400 kHz bus; the data sheet names 800 Hz as the most for it.
RATE_CODES: Mapping[float, int] = {800.0 / 2.0**step: 0x0D - step for step in range(10)}
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


def limits(range_g: int) -> tuple[int, int]:
    """Lowest and highest count: 10 bits at 2 g, one more for each doubling of the range."""
    return -COUNTS_PER_G * range_g, COUNTS_PER_G * range_g - 1


def settings(rate_hz: float, range_g: int) -> dict[int, tuple[str, int]]:
    """Name and value by register while measuring: offsets zero, no event detection, no self-test, FIFO in stream mode.

    The part has no reset, so all that can be set is.
    """
    values = dict.fromkeys(SETTING_NAMES, 0)
    values[BW_RATE] = RATE_CODES[rate_hz]
    values[POWER_CTL] = MEASURE
    values[DATA_FORMAT] = _FULL_RESOLUTION | RANGE_CODES[range_g]
    values[FIFO_CTL] = STREAM
    return {register: (SETTING_NAMES[register], value) for register, value in values.items()}


def self_test(range_g: int) -> SelfTest:
    """The SELF_TEST bit. Data sheet: 0.20 to 2.10 g in x, as much the other way in y, 0.30 to 3.40 g in z at 2.5 V;
    at 3.3 V 1.77 and 1.47 times as much (tables 1 and 14). The supply is not known, so both are accepted; the limits
    hold at 100 to 800 Hz (page 22). Noise in counts, any rate."""
    return SelfTest(
        writes=((DATA_FORMAT, _SELF_TEST | _FULL_RESOLUTION | RANGE_CODES[range_g]),),
        settle_s=0.1,
        low_g=(0.20, -2.10 * 1.77, 0.30),
        high_g=(2.10 * 1.77, -0.20, 3.40 * 1.47),
        noise_g=(0.75 / COUNTS_PER_G, 0.75 / COUNTS_PER_G, 1.1 / COUNTS_PER_G),
        source="ADXL345 data sheet, self-test at 2.5 and 3.3 V, noise at 100 Hz",
    )
