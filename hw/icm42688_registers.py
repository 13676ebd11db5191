"""Registers of the ICM-42688-P and the meaning of their contents. A register's number has its bank in the upper byte.

Source: data sheet DS-000347 (revision 1.5), sections named below. Compared with Linux, drivers/iio/imu/inv_icm42600
(packet 1 of 8 bytes, headers, codes of rate and range, partial reads), Zephyr, drivers/sensor/tdk/icm42688, and TDK's
driver inv_icm426xx (records as the unit of the count, factory values of the self-test). They agree but for:

- FIFO_COUNT: the data sheet says that a read of FIFO_COUNTL latches the count; Linux notes that the first read after a
  reset gives 0. A single read may thus give the count of the read before. See `Icm42688`.
- FIFO mode: Linux lets new samples overwrite old ones, TDK's driver stops when the FIFO is full. Used here: Linux's.
- After a flush of the FIFO the first packet may be wrong in some 5 % of the parts (PX4-Autopilot pull request 20181);
  the data sheet states no time to wait.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.fifo import FifoSamples
from hw.self_test import SelfTest

WHO_AM_I, IDENTITY, BANK_SELECT = 0x75, 0x47, 0x76
DEVICE_CONFIG, FIFO_CONFIG, TEMPERATURE, INT_STATUS, FIFO_COUNT_L, FIFO_DATA = 0x11, 0x16, 0x1D, 0x2D, 0x2F, 0x30
SIGNAL_PATH_RESET, POWER, SELF_TEST_CONFIG, SELF_TEST_CODES = 0x4B, 0x4E, 0x70, 0x23B
RESET, FLUSH = 0x01, 0x02
OFF, ON = 0x00, 0x0F  # POWER: accelerometer and gyroscope in low-noise mode
FULL = 0x02  # in INT_STATUS, cleared when it is read
PACKET_BYTES = 8  # header, three numbers, temperature
FIFO_PACKETS = 255  # 2048 bytes without the packet that is kept free for writing
LIMITS = -32766, 32767  # lower numbers do not occur in valid samples
COUNTS_PER_G: Mapping[int, int] = {16: 2048, 8: 4096, 4: 8192, 2: 16384}  # in the order of the range codes
SELF_TEST_RANGE_G = 4
_INVALID = -(2**15)
_PACKET, _PACKET_MASK = 0x40, 0xFC  # header of a packet with the accelerometer alone


@dataclass(frozen=True, slots=True)
class Rate:
    """Code of an output data rate, and its filter: corner at 3 dB, and delay of the whole path at low frequencies."""

    code: int
    corner_hz: float
    delay_s: float


# Section 5.5, second-order filter, bandwidth code 0: the widest one, about half the rate. At lower rates every filter
# is wider than half the rate.
RATES: Mapping[float, Rate] = {
    1000.0: Rate(6, 493.3, 0.7e-3),
    500.0: Rate(15, 246.7, 1.3e-3),
    200.0: Rate(7, 98.7, 3.3e-3),
    100.0: Rate(8, 49.3, 6.5e-3),
    50.0: Rate(9, 24.7, 12.9e-3),
    25.0: Rate(10, 12.3, 25.7e-3),
}
_ANTI_ALIAS_HZ = 1163.0  # section 5.3, with the values that ACCEL_CONFIG_STATIC2 to 4 have after a reset


def filters(rate_hz: float) -> tuple[str, ...]:
    """The filters at an output data rate, as in DeviceInfo.

    The noise bandwidths of section 5.5 are those of a second-order filter whose corner differs from the stated one by
    up to 5 %; whether the anti-alias filter is contained in the table is not stated.
    """
    rate = RATES[rate_hz]
    later_s = rate.delay_s - 2**0.5 / (2 * np.pi * rate.corner_hz)
    return (
        f"lowpass order=2 corner_hz={rate.corner_hz:g} u_corner_pct=10",
        f"lowpass order=2 corner_hz={_ANTI_ALIAS_HZ:g} u_corner_pct=25",
        f"delay delay_s={later_s:.3g}",
    )


def settings(rate_hz: float, range_g: int) -> dict[int, tuple[str, int]]:
    """Register -> (name, value) while measuring.

    Only the accelerometer goes into the FIFO. The gyroscope is on because its clock is more stable (section 4.10: 1 %
    instead of 8 %). The count is in packets; numbers are big-endian; the FIFO can be read in parts; the interface is
    set for I2C (section 12.3). The interrupt is enabled because its status bit is read; its pin may stay unconnected.
    """
    code = RATES[rate_hz].code
    offsets = {0x47B + i: (f"OFFSET_USER{4 + i}", 0x00) for i in range(5)}
    return {
        0x13: ("DRIVE_CONFIG", 0x09),
        FIFO_CONFIG: ("FIFO_CONFIG", 0x40),
        0x4C: ("INTF_CONFIG0", 0x70),
        0x4D: ("INTF_CONFIG1", 0x91),
        POWER: ("PWR_MGMT0", ON),
        0x4F: ("GYRO_CONFIG0", code),
        0x50: ("ACCEL_CONFIG0", list(COUNTS_PER_G).index(range_g) << 5 | code),
        0x52: ("GYRO_ACCEL_CONFIG0", 0x01),
        0x53: ("ACCEL_CONFIG1", 0x0D),
        0x5F: ("FIFO_CONFIG1", 0x41),
        0x65: ("INT_SOURCE0", FULL),
        SELF_TEST_CONFIG: ("SELF_TEST_CONFIG", 0x00),
        BANK_SELECT: ("REG_BANK_SEL", 0x00),
        0x17C: ("INTF_CONFIG6", 0x5C),
        0x203: ("ACCEL_CONFIG_STATIC2", 0x30),
        0x204: ("ACCEL_CONFIG_STATIC3", 0x40),
        0x205: ("ACCEL_CONFIG_STATIC4", 0x62),
    } | offsets


def temperature(data: bytes) -> tuple[int, float]:
    """Raw value and degC (section 4.13): 132.48 LSB per degC, 0 at 25 degC."""
    raw = int.from_bytes(data, "big", signed=True)
    return raw, raw / 132.48 + 25.0


def self_test(codes: bytes, rate_hz: float) -> SelfTest:
    """Self-test of all three axes; `codes` are the factory values of the three axes.

    TDK's driver (inv_icm426xx_selftest.c): a code stands for 2620 * 1.01^(code - 1) counts at 2 g, and the change must
    be 0.5 to 1.5 times that; without a code 50 to 1200 mg. The noise is 70 ug per square root of Hz in the data sheet.
    Registers other than rate, range and mode may be written only while the sensors are off (section 12.9).
    """
    factory_g = [2620 * 1.01 ** (code - 1) / COUNTS_PER_G[2] if code else None for code in codes]
    x, y, z = ((0.05, 1.2) if g is None else (0.5 * g, 1.5 * g) for g in factory_g)
    noise_g = 70e-6 * (1.11 * RATES[rate_hz].corner_hz) ** 0.5
    return SelfTest(
        writes=((POWER, OFF), (SELF_TEST_CONFIG, 0x78), (POWER, ON)),
        settle_s=0.2,
        low_g=(x[0], y[0], z[0]),
        high_g=(x[1], y[1], z[1]),
        noise_g=(noise_g, noise_g, noise_g),
        source="factory values stored in the ICM-42688-P, within 50%",
    )


def without_empty(data: bytes) -> bytes:
    """`data` without what an empty FIFO gives: packets of 0xFF.

    Section 6.2 names bit 7 of the header alone. In a FIFO out of step the upper byte of a negative number looks so.
    """
    packets = _packets(data)
    return bytes(packets[(packets != 0xFF).any(axis=1)].tobytes())


def in_step(data: bytes) -> bool:
    """Whether each 8 bytes begin with the header of a packet of the accelerometer alone."""
    return bool((_packets(data)[:, 0] & _PACKET_MASK == _PACKET).all())


def samples(data: bytes) -> FifoSamples:
    """Samples in a sequence of packets (section 6.1, packet 1).

    A packet with an invalid sample or another header is dropped, and the next sample does not follow the one before.
    """
    packets = _packets(data)
    counts = np.ascontiguousarray(packets[:, 1:7]).view(">i2").astype(np.int32)
    good = (packets[:, 0] & _PACKET_MASK == _PACKET) & (counts != _INVALID).all(axis=1)
    last = np.flatnonzero(good)
    ends = np.concatenate([last, [len(packets)]])
    breaks = np.flatnonzero(np.diff(ends, prepend=-1) != 1).tolist()
    return FifoSamples(counts[last], last, breaks, len(packets) - len(last), b"")


def _packets(data: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8).reshape(-1, PACKET_BYTES)
