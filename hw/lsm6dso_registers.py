"""Registers of the LSM6DSO and LSM6DSOX (the registers used here are the same) and the meaning of their contents.

Sources: data sheets LSM6DSO and LSM6DSOX, application notes AN5192 and AN5272 (actual output data rate); names and bits
also in ST's lsm6dsox-pid (lsm6dsox_reg.h) and in Linux, drivers/iio/imu/st_lsm6dsx.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hw.fifo import FifoSamples
from hw.self_test import SelfTest
from hw.spi import SpiProtocol

WHO_AM_I, IDENTITY = 0x0F, 0x6C
FIRST_FIFO_SETTING, FIFO_CTRL3, FIFO_CTRL4, FIFO_STATUS, FIFO_DATA = 0x07, 0x09, 0x0A, 0x3A, 0x78
CTRL1_XL, CTRL3_C, CTRL5_C, TEMPERATURE, FREQ_FINE, USER_OFFSET = 0x10, 0x12, 0x14, 0x20, 0x63, 0x73
FUNC_CFG_ACCESS = 0x01
SOFTWARE_RESET = 0x01  # in CTRL3_C, clears itself
BYPASS, CONTINUOUS = 0x00, 0x06  # FIFO_CTRL4
OVERRUN = 0x48  # in the second byte of FIFO_STATUS: overrun now, and overrun latched until FIFO_STATUS is read
COUNT_MASK = 0x3FF
# Bit of a read: Linux, st_lsm6dsx_spi.c; IF_INC in CTRL3_C, set by a reset, counts the register up. Modes 0 and 3: data
# sheet, as quoted in issue 4 of SparkFun_Qwiic_6DoF_LSM6DSO_Arduino_Library. 10 MHz: SPI slave timing values of ST's
# LSM9DS1 and LSM6DSK320X; those of the LSM6DSO were not read. I2C stays enabled (I2C_disable in CTRL4_C is 0): the
# settings, and with them the identity of the device and its calibration, do not depend on the bus.
SPI = SpiProtocol(mode=0, highest_mhz=10.0, read=0x80)
FIFO_WORDS = 512
WORD_BYTES = 7
LIMITS = -(2**15), 2**15 - 1
# Data sheet, mg/LSB by range in g, in the order of the range codes.
MG_PER_COUNT: Mapping[int, float] = {2: 0.061, 16: 0.488, 4: 0.122, 8: 0.244}
RATES_HZ = (12.5, 26.0, 52.0, 104.0, 208.0, 416.0, 833.0, 1667.0, 3333.0, 6667.0)  # index + 1 is the code
_INTERNAL_HZ, _FINE_STEP = 6667.0, 0.0015
_BLOCK_DATA_UPDATE, _AUTO_INCREMENT, _RESET_CTRL9, _DEVICE_CONF = 0x40, 0x04, 0xE0, 0x02
ACCELEROMETER = 2  # tag of the accelerometer


def actual_rate_hz(rate_hz: float, freq_fine: int) -> float:
    """Rate that the part states, Hz, from its register INTERNAL_FREQ_FINE (`freq_fine`).

    6667 Hz (1 + 0.0015 FREQ_FINE), divided by a power of two (AN5272, ODR actual).
    """
    signed = freq_fine - 256 if freq_fine > 127 else freq_fine
    divider = 2 ** (len(RATES_HZ) - 1 - RATES_HZ.index(rate_hz))
    return float(_INTERNAL_HZ * (1 + _FINE_STEP * signed) / divider)


def filters(rate_hz: float) -> tuple[str, ...]:
    """The filter at an output data rate, as in DeviceInfo.

    AN5192, accelerometer bandwidth: without the second filter the bandwidth is half the output data rate. It tells no
    order: the standard uncertainty is so large that first and second order lie within U.
    """
    return (f"lowpass order=1 corner_hz={rate_hz / 2.0:g} u_corner_pct=50",)


def self_test(rate_hz: float) -> SelfTest:
    """Positive self-test. Data sheet DS12140, table 2: 50 to 1700 mg at any range.

    The noise is 70 ug per square root of Hz (at 2 g) over half the rate.
    """
    noise_g = 70e-6 * (rate_hz / 2) ** 0.5
    return SelfTest(
        writes=((CTRL5_C, 0x01),),
        settle_s=0.1,
        low_g=(0.05, 0.05, 0.05),
        high_g=(1.7, 1.7, 1.7),
        noise_g=(noise_g, noise_g, noise_g),
        source="LSM6DSO data sheet, linear acceleration self-test output change",
    )


def temperature(data: bytes) -> tuple[int, float]:
    """Raw value and degC: 256 LSB per degC, 0 at 25 degC."""
    raw = int.from_bytes(data, "little", signed=True)
    return raw, 25.0 + raw / 256.0


def settings(rate_hz: float, range_g: int) -> dict[int, tuple[str, int]]:
    """Register -> (name, value) while measuring.

    The accelerometer alone is on, in high-performance mode; no second filter, no user offset, no self-test, FIFO in
    continuous mode.
    """
    code = RATES_HZ.index(rate_hz) + 1
    names = ("FIFO_CTRL1", "FIFO_CTRL2", "FIFO_CTRL3", "FIFO_CTRL4")
    values = dict.fromkeys(enumerate(names, FIRST_FIFO_SETTING), 0)
    controls = ("1_XL", "2_G", "3_C", "4_C", "5_C", "6_C", "7_G", "8_XL", "9_XL", "10_C")
    values |= dict.fromkeys(enumerate((f"CTRL{name}" for name in controls), CTRL1_XL), 0)
    values |= dict.fromkeys(enumerate(("X_OFS_USR", "Y_OFS_USR", "Z_OFS_USR"), USER_OFFSET), 0)
    values[FIFO_CTRL3, "FIFO_CTRL3"] = code
    values[FIFO_CTRL4, "FIFO_CTRL4"] = CONTINUOUS
    values[CTRL1_XL, "CTRL1_XL"] = code << 4 | list(MG_PER_COUNT).index(range_g) << 2
    values[CTRL3_C, "CTRL3_C"] = _BLOCK_DATA_UPDATE | _AUTO_INCREMENT
    values[0x18, "CTRL9_XL"] = _RESET_CTRL9 | _DEVICE_CONF  # AN5192: DEVICE_CONF must be set
    return {register: (name, value) for (register, name), value in values.items()}


def tagged_samples(data: bytes, last_counter: int | None) -> tuple[FifoSamples, int | None]:
    """Accelerometer samples in a sequence of FIFO words, and the counter of the last word.

    A word is a tag byte and three 16-bit numbers. Tag: bits 7:3 sensor, 2:1 counter, bit 0 makes the parity even. Words
    of another sensor or with wrong parity are dropped. Where the counter does not increase by one there is a break;
    `last_counter` is the counter before `data`, or None if any first counter is accepted.
    """
    words = np.frombuffer(data, np.uint8).reshape(-1, WORD_BYTES)
    tag = words[:, 0]
    good = (tag >> 3 == ACCELEROMETER) & (np.bitwise_count(tag) % 2 == 0)
    last = np.flatnonzero(good)
    counter = (tag[last] >> 1 & 3).astype(np.int64)
    before = counter[:1] - 1 if last_counter is None else last_counter
    steps = np.diff(counter, prepend=before) % 4 if len(counter) else counter
    counts = np.ascontiguousarray(words[last, 1:]).view("<i2").astype(np.int32)
    samples = FifoSamples(counts, last, np.flatnonzero(steps != 1).tolist(), len(words) - len(last), b"")
    return samples, int(counter[-1]) if len(counter) else last_counter
