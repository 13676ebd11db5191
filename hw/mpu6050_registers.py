"""Registers of the MPU-6050, MPU-6500 and MPU-9250 and the meaning of their contents.

Sources: register maps RM-MPU-6000A, RM-MPU-6500A and RM-MPU-9250A, specification PS-MPU-6000A. Identities, FIFO sizes
and temperature lines are also in Linux, drivers/iio/imu/inv_mpu6050 (inv_mpu_iio.h, inv_mpu_core.c: offsets 12420 and
7011 LSB, 2.941176 and 2.995178 mK/LSB). LSB/g, noise and tolerance of the MPU-9250: PS-MPU-9250A-01, table 2.

Bandwidths: of the MPU-6050 as in RM-MPU-6000A; of the MPU-6500 as in pif (EnPifMpu6500ADlpfCfg: 184, 92, 41 Hz). Of
the MPU-9250, libcaer (davis.h) and the crate mpu9250 (Dlpf) say 218.1, 99, 44.8 Hz; other drivers have the MPU-6500's
(DLPF_BANDWIDTH_184HZ of MPU9250.cpp), which lie within U. Of the MPU-6886, a driver for M5StickC (MPU6886s.cpp) quotes
218.1, 99, 44.8 Hz.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from hw.self_test import SelfTest

SAMPLE_RATE_DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG, ACCEL_CONFIG_2, FIFO_EN = 0x19, 0x1A, 0x1B, 0x1C, 0x1D, 0x23
INT_ENABLE, INT_STATUS, TEMPERATURE, USER_CTRL, POWER_1, POWER_2 = 0x38, 0x3A, 0x41, 0x6A, 0x6B, 0x6C
SELF_TEST, FIFO_COUNT, FIFO_DATA, WHO_AM_I = 0x0D, 0x72, 0x74, 0x75
DEVICE_RESET, CLOCK_FROM_GYRO = 0x80, 0x01
FIFO_RESET, FIFO_ON = 0x04, 0x40
OVERFLOW = 0x10  # in INT_STATUS and INT_ENABLE
SAMPLE_BYTES = 6
COUNTS_PER_G: Mapping[int, int] = {2: 16384, 4: 8192, 8: 4096, 16: 2048}
# Of an MPU-6050: at 2 g the self-test and gravity together reach the end of the range (RM-MPU-6000A, 4.1)
SELF_TEST_RANGE_G = 8
LIMITS = -(2**15), 2**15 - 1
RATES_HZ = tuple(1000.0 / (divider + 1) for divider in (0, 1, 3, 4, 7, 9, 19, 39, 99, 249))
_ACCEL_INTO_FIFO = 0x08
# Bandwidth of the digital low-pass filter, Hz, by its code from 1 on. Code 0 is not used: with it the MPU-6050 divides
# 8 kHz, not 1 kHz, to make the sample rate.
_BANDWIDTHS_6050_HZ = (184.0, 94.0, 44.0, 21.0, 10.0, 5.0)
_BANDWIDTHS_6500_HZ = (184.0, 92.0, 41.0, 20.0, 10.0, 5.0)
_BANDWIDTHS_9250_HZ = (218.1, 99.0, 44.8, 21.2, 10.2, 5.05)
_BANDWIDTHS_6886_HZ = (218.1, 99.0, 44.8, 21.2, 10.2, 5.1)


@dataclass(frozen=True, slots=True)
class Part:
    """Properties in which the parts of the family differ."""

    kind: str
    fifo_bytes: int
    accel_offset: range  # offset registers of the accelerometer, which hold the factory trim
    accel_config_2: bool
    counts_per_degc: float
    zero_count_degc: float
    bandwidths_hz: tuple[float, ...]  # empty where they are not known

    def temperature(self, data: bytes) -> tuple[int, float]:
        """Raw value and degC from the two bytes of the temperature registers."""
        raw = int.from_bytes(data, "big", signed=True)
        return raw, raw / self.counts_per_degc + self.zero_count_degc


_LATER = 512, range(0x77, 0x7F), True, 333.87, 21.0  # the MPU-6500 and later
_MPU6050 = Part("MPU-6050", 1024, range(0x06, 0x0C), False, 340.0, 36.53, _BANDWIDTHS_6050_HZ)
PARTS: Mapping[int, Part] = {
    0x68: _MPU6050,
    0x70: Part("MPU-6500", *_LATER, _BANDWIDTHS_6500_HZ),
    0x71: Part("MPU-9250", *_LATER, _BANDWIDTHS_9250_HZ),
    0x73: Part("MPU-9255", *_LATER, _BANDWIDTHS_9250_HZ),
    0x74: Part("MPU-6515", *_LATER, _BANDWIDTHS_6500_HZ),
}
"""By WHO_AM_I."""
_CLONES_BANDWIDTHS_HZ = {0x19: _BANDWIDTHS_6886_HZ}


def clone(who_am_i: int) -> Part:
    """Properties assumed for a part with another WHO_AM_I; its FIFO size is that of the later parts, the smaller
    one."""
    return Part(f"MPU clone 0x{who_am_i:02X}", *_LATER, _CLONES_BANDWIDTHS_HZ.get(who_am_i, ()))


def low_pass_code(rate_hz: float) -> int:
    """Code of the widest filter with a bandwidth of at most half the rate, as Linux chooses it."""
    fitting = (code for code, hz in enumerate(_BANDWIDTHS_6050_HZ, 1) if hz <= rate_hz / 2)
    return min(fitting, default=len(_BANDWIDTHS_6050_HZ))


def filters(rate_hz: float, part: Part = _MPU6050) -> tuple[str, ...]:
    """The filter at a sample rate, as in DeviceInfo; empty for a part of which no source tells the bandwidths.

    The sources tell the bandwidth of each code and no order: the standard uncertainty is so large that first and second
    order lie within U. While the part is not known, the MPU-6050 is assumed; the bandwidths of the others, which differ
    by up to 19 %, lie within U, too.
    """
    if not part.bandwidths_hz:
        return ()
    return (f"lowpass order=1 corner_hz={part.bandwidths_hz[low_pass_code(rate_hz) - 1]:g} u_corner_pct=50",)


def settings(part: Part, rate_hz: float, range_g: int) -> dict[int, tuple[str, int]]:
    """Register -> (name, value) while measuring: only the accelerometer in the FIFO, no self-test.

    The clock is that of the gyroscope, which is more stable than the internal one; therefore the gyroscope is on. The
    overflow interrupt is enabled because its status bit is read; its pin may be left unconnected.
    """
    low_pass = low_pass_code(rate_hz)
    values = {
        SAMPLE_RATE_DIV: ("SMPLRT_DIV", round(1000.0 / rate_hz) - 1),
        CONFIG: ("CONFIG", low_pass),
        GYRO_CONFIG: ("GYRO_CONFIG", 0),
        ACCEL_CONFIG: ("ACCEL_CONFIG", list(COUNTS_PER_G).index(range_g) << 3),
        FIFO_EN: ("FIFO_EN", _ACCEL_INTO_FIFO),
        INT_ENABLE: ("INT_ENABLE", OVERFLOW),
        USER_CTRL: ("USER_CTRL", FIFO_ON),
        POWER_1: ("PWR_MGMT_1", CLOCK_FROM_GYRO),
        POWER_2: ("PWR_MGMT_2", 0),
    }
    if part.accel_config_2:
        values[ACCEL_CONFIG_2] = ("ACCEL_CONFIG_2", low_pass)
    return dict(sorted(values.items()))


def factory_trim_g(part: Part, codes: bytes) -> list[float]:
    """Change of the indication by the self-test as measured in the factory, in g, by axis.

    `codes` are the four bytes from the register SELF_TEST on. A code of 0 gives 0.

    MPU-6050 (RM-MPU-6000A, 4.1): 0.34 (0.92 / 0.34)^((code - 1) / 30) g. MPU-6500 and later (AN-MPU-9250A-03): 2620 *
    1.01^(code - 1) counts at 2 g.
    """
    if part.accel_config_2:
        return [2620 * 1.01 ** (code - 1) / COUNTS_PER_G[2] if code else 0.0 for code in codes[:3]]
    five_bits = [codes[i] >> 3 & 0x1C | codes[3] >> (4 - 2 * i) & 0x03 for i in range(3)]
    return [0.34 * (0.92 / 0.34) ** ((code - 1) / 30) if code else 0.0 for code in five_bits]


def self_test(part: Part, codes: bytes, rate_hz: float, range_g: int) -> SelfTest:
    """Self-test of all three axes, with limits around the factory values in `codes`.

    MPU-6050: within 14 % of the factory value (PS-MPU-6000A). Later parts: 0.5 to 1.5 times the factory value
    (AN-MPU-9250A-03). The noise is 400 ug (MPU-6050) or 300 ug per square root of Hz over the bandwidth of the filter.
    """
    spread = 0.5 if part.accel_config_2 else 0.14
    x, y, z = factory_trim_g(part, codes)
    noise_g = (300e-6 if part.accel_config_2 else 400e-6) * _BANDWIDTHS_6050_HZ[low_pass_code(rate_hz) - 1] ** 0.5
    return SelfTest(
        writes=((ACCEL_CONFIG, 0xE0 | list(COUNTS_PER_G).index(range_g) << 3),),
        settle_s=0.1,
        low_g=(x * (1 - spread), y * (1 - spread), z * (1 - spread)),
        high_g=(x * (1 + spread), y * (1 + spread), z * (1 + spread)),
        noise_g=(noise_g, noise_g, noise_g),
        source=f"factory values stored in the {part.kind}, within {spread:.0%}",
    )
