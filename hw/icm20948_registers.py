"""Registers of the ICM-20948 and the meaning of their contents. A register's number has its bank in the upper byte.

Sources: data sheet DS-000189 (revision 1.3); SparkFun_ICM-20948_ArduinoLibrary (ICM_20948_REGISTERS.h,
ICM_20948_ENUMERATIONS.h, ICM_20948_C.c: registers, bandwidths); Klipper (klippy/extras/icm20948.py and
src/sensor_icm20948.c: the accelerometer alone in the FIFO, 512 bytes, INT_STATUS_2); Zephyr,
drivers/sensor/tdk/icm20948. What they do not agree on:

- Range of the low-pass filter: 5.7 to 246 Hz in the specification of the data sheet; SparkFun has 473 Hz, too (code 7).
- Temperature: SparkFun takes 21 LSB off before the division, which is 0.06 K; the data sheet 0 LSB at 21 degC.
- Reset of the FIFO: FIFO_RST 1F then 1E in SparkFun, as InvenSense's examples have it for the motion processor's FIFO;
  1 then 0 in ICM20948_WE; the reset bits of USER_CTRL in Klipper. Used here: 1F then 0, "assert and de-assert".
"""

from __future__ import annotations

from collections.abc import Mapping

from hw.self_test import SelfTest

WHO_AM_I, IDENTITY, BANK_SELECT = 0x00, 0xEA, 0x7F
OTHER_WHO_AM_I = 0x75  # where the parts of the MPU family and the ICM-42688-P have theirs
USER_CTRL, POWER_1, INT_STATUS_2, TEMPERATURE, FIFO_RST, FIFO_COUNT, FIFO_DATA = (
    0x03,
    0x06,
    0x1B,
    0x39,
    0x68,
    0x70,
    0x72,
)
SELF_TEST_CODES, ACCEL_CONFIG, ACCEL_CONFIG_2 = 0x10E, 0x214, 0x215
# Factory trim of the offsets
TRIMS: Mapping[int, str] = {
    0x114: "XA_OFFS_H", 0x115: "XA_OFFS_L", 0x117: "YA_OFFS_H", 0x118: "YA_OFFS_L", 0x11A: "ZA_OFFS_H",
    0x11B: "ZA_OFFS_L",
}  # fmt: skip
DEVICE_RESET, AWAKE, FIFO_ON, ALL_FIFOS = 0x80, 0x01, 0x40, 0x1F
COUNT_MASK = 0x1FFF
OVERFLOW = 0x1F  # in INT_STATUS_2
FIFO_BYTES = 512
SAMPLE_BYTES = 6
LIMITS = -(2**15), 2**15 - 1
COUNTS_PER_G: Mapping[int, int] = {2: 16384, 4: 8192, 8: 4096, 16: 2048}  # in the order of the range codes
SELF_TEST_RANGE_G = 4
RATES_HZ = tuple(1125.0 / (divider + 1) for divider in (0, 1, 2, 3, 4, 7, 9, 14, 19, 24, 49, 99))
# Bandwidth of the digital low-pass filter by its code
_BANDWIDTH_HZ: Mapping[int, float] = {7: 473.0, 1: 246.0, 2: 111.4, 3: 50.4, 4: 23.9, 5: 11.5, 6: 5.7}


def low_pass_code(rate_hz: float) -> int:
    """Code of the widest filter with a bandwidth of at most half the rate."""
    return next((code for code, hz in _BANDWIDTH_HZ.items() if hz <= rate_hz / 2), 6)


def filters(rate_hz: float) -> tuple[str, ...]:
    """The filter at a sample rate, as in DeviceInfo.

    The sources tell bandwidth and noise bandwidth of each code; their ratio, 1.06 to 1.48, is that of an order between
    the first and the third. The standard uncertainty is so large that first and second order lie within U.
    """
    return (f"lowpass order=1 corner_hz={_BANDWIDTH_HZ[low_pass_code(rate_hz)]:g} u_corner_pct=50",)


def settings(rate_hz: float, range_g: int) -> dict[int, tuple[str, int]]:
    """Register -> (name, value) while measuring.

    The accelerometer alone is on, and alone in the FIFO; no self-test, no duty cycle; the FIFO overwrites old samples.
    The overflow interrupt is enabled because its status bit is read; its pin may be left unconnected.
    """
    divider = round(1125.0 / rate_hz) - 1
    return {
        USER_CTRL: ("USER_CTRL", FIFO_ON),
        0x05: ("LP_CONFIG", 0x40),
        POWER_1: ("PWR_MGMT_1", AWAKE),
        0x07: ("PWR_MGMT_2", 0x07),
        0x12: ("INT_ENABLE_2", OVERFLOW),
        0x66: ("FIFO_EN_1", 0x00),
        0x67: ("FIFO_EN_2", 0x10),
        FIFO_RST: ("FIFO_RST", 0x00),
        0x69: ("FIFO_MODE", 0x00),
        BANK_SELECT: ("REG_BANK_SEL", 0x00),
        0x210: ("ACCEL_SMPLRT_DIV_1", divider >> 8),
        0x211: ("ACCEL_SMPLRT_DIV_2", divider & 0xFF),
        ACCEL_CONFIG: ("ACCEL_CONFIG", low_pass_code(rate_hz) << 3 | list(COUNTS_PER_G).index(range_g) << 1 | 0x01),
        ACCEL_CONFIG_2: ("ACCEL_CONFIG_2", 0x00),
    }


def temperature(data: bytes) -> tuple[int, float]:
    """Raw value and degC (data sheet): 333.87 LSB per degC, 0 at 21 degC."""
    raw = int.from_bytes(data, "big", signed=True)
    return raw, raw / 333.87 + 21.0


def self_test(codes: bytes, rate_hz: float) -> SelfTest:
    """Self-test of all three axes; `codes` are the factory values of the three axes.

    InvenSense's Linux driver for parts with these banks (inv_mpu, mpu_st_tb and DEF_ACCEL_ST_SHIFT_DELTA): a code
    stands for 2620 * 1.01^(code - 1) counts at 2 g, and the change must be 0.5 to 1.5 times that; without a code 225 to
    675 mg. The noise is 230 ug per square root of Hz in the data sheet.
    """
    factory_g = [2620 * 1.01 ** (code - 1) / COUNTS_PER_G[2] if code else None for code in codes]
    x, y, z = ((0.225, 0.675) if g is None else (0.5 * g, 1.5 * g) for g in factory_g)
    noise_g = 230e-6 * _BANDWIDTH_HZ[low_pass_code(rate_hz)] ** 0.5
    return SelfTest(
        writes=((ACCEL_CONFIG_2, 0x1C),),
        settle_s=0.1,
        low_g=(x[0], y[0], z[0]),
        high_g=(x[1], y[1], z[1]),
        noise_g=(noise_g, noise_g, noise_g),
        source="factory values stored in the ICM-20948, within 50%",
    )
