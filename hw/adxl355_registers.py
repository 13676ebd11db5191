"""Registers of the ADXL355, ADXL357 and ADXL359 and the meaning of their contents: pure functions, no bus.

Sources: data sheets ADXL354/ADXL355 and ADXL356/ADXL357 (specification and register tables). For the ADXL359: Linux,
drivers/iio/accel/adxl355_core.c (part ID, 19.5 ug/LSB at 10 g, temperature intercept).

The ADXL357 has the same part ID as the ADXL355 (0xED, in the data sheets and in the public drivers that check the ID).
Only the configuration tells which of the two parts is connected.

LSB/g: Zephyr (adxl355_decoder.c) has the values of the data sheet; Linux and no-OS round to 3.9 and 19.5 ug/LSB, which
is 0.16 % less. Temperature: the ADXL355's values are also in Zephyr and no-OS. The ADXL357's intercept is 1852 in the
data sheet and in other public drivers, but 1885 in no-OS, which is a difference of 3.6 K.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hw.fifo import FifoSamples
from hw.self_test import Axes, SelfTest
from hw.spi import SpiProtocol

DEVID, REVISION, STATUS, TEMPERATURE, FIFO_DATA = 0x00, 0x03, 0x04, 0x06, 0x11
FIRST_SETTING, FILTER, RANGE, POWER_CTL, SELF_TEST, RESET, SHADOW = 0x1E, 0x28, 0x2C, 0x2D, 0x2E, 0x2F, 0x50
SHADOW_BYTES = 5
LOADING = b"\xff" * 4  # what the first registers read while the device loads its trim; Zephyr (adxl355.c) tells it
RESET_CODE = 0x52
MEASURE = 0x00  # POWER_CTL
_ST1, _ST2 = 0x01, 0x02  # SELF_TEST
OVERRUN, NVM_BUSY = 0x04, 0x10  # in STATUS
TEMPERATURE_WITHIN = 16  # LSB, of two readings that belong together; noise is less, and a torn reading is off by 256
FIFO_ENTRIES_MAX = 96
SETTING_NAMES = (
    *("OFFSET_X_H", "OFFSET_X_L", "OFFSET_Y_H", "OFFSET_Y_L", "OFFSET_Z_H", "OFFSET_Z_L"),
    *("ACT_EN", "ACT_THRESH_H", "ACT_THRESH_L", "ACT_COUNT", "FILTER", "FIFO_SAMPLES"),
    *("INT_MAP", "SYNC", "RANGE", "POWER_CTL", "SELF_TEST"),
)
# Seven bits of register before the bit of a read: Linux, drivers/iio/accel/adxl355_spi.c. Mode 0: no-OS,
# eval-adxl355-pmdz. 0.1 to 10 MHz: the data sheet, as a user quotes it (ez.analog.com, thread 100077).
SPI = SpiProtocol(mode=0, highest_mhz=10.0, read=0x01, shift=1)
RATES_HZ = tuple(4000.0 / 2.0**code for code in range(11))  # index: the code in FILTER
# Data sheets of the ADXL355 and ADXL359, "I2C protocol": at most 800 Hz at 400 kHz, in proportion to the clock; else
# samples may be missing and noise added
STATED_HZ_A_KHZ = 2.0
# The same section: a part acknowledges the bytes 0x3A and 0x3B (at 0x53: 0xA6 and 0xA7) in messages to other devices,
# and pulls SDA down. The sheets, in which REVID is 1, name no revision without this fault. In the ADXL371 and ADXL372 a
# fault of this kind ended with revision 3 (no-OS, adxl372.c); the same is assumed here.
FIRST_FREE_REVISION = 3
MUST_BE_ALONE = (
    f"a part whose REVID is below {FIRST_FREE_REVISION} answers bytes that are meant for others, so it must be the "
    "only device on its bus"
)
_LATE_S = 0.17e-3  # delay of the path at any rate, besides that of its filters
_FIXED_FILTERS_S, _DRIVE_STOPS_S = 1.4e-3, 0.5e-3
COUNTS_MIN, COUNTS_MAX = -(2**19), 2**19 - 1
_RANGE_RESET_BITS = 0x80  # I2C high-speed bits, set by a reset and kept
_X_MARK, _EMPTY = 0x01, 0x02  # in the last byte of a FIFO entry
_FULL = bytes(last for last in range(256) if not last & _EMPTY)  # last bytes of the entries that hold a value


@dataclass(frozen=True, slots=True)
class Part:
    """Properties in which the parts of the family differ.

    `counts_per_g` maps the range in g to its counts per g, lowest range first; the register codes are 1, 2, 3 in this
    order.
    """

    kind: str
    identity: bytes  # the three ID registers: Analog Devices, MEMS, part
    counts_per_g: Mapping[int, int]
    temperature_intercept: int  # LSB at 25 degC; the slope is -9.05 LSB per degC in all parts
    noise_g: float  # g per square root of Hz, at the lowest range
    self_test_low_g: Axes
    self_test_high_g: Axes


_LIMITS_355 = (0.1, 0.1, 0.5), (0.6, 0.6, 3.0)
_LIMITS_357 = (0.01, 0.01, 0.5), (3.0, 3.0, 3.0)
ADXL355 = Part("ADXL355", bytes([0xAD, 0x1D, 0xED]), {2: 256000, 4: 128000, 8: 64000}, 1885, 22.5e-6, *_LIMITS_355)
ADXL357 = Part("ADXL357", bytes([0xAD, 0x1D, 0xED]), {10: 51200, 20: 25600, 40: 12800}, 1852, 75e-6, *_LIMITS_357)
ADXL359 = Part("ADXL359", bytes([0xAD, 0x1D, 0xE9]), {10: 51200, 20: 25600, 40: 12800}, 1852, 75e-6, *_LIMITS_357)


def settings(part: Part, rate_hz: float, range_g: int) -> bytes:
    """Values of the registers FIRST_SETTING to SELF_TEST while measuring, for `rate_hz` and `range_g`.

    The offset registers are zero and the high-pass filter is off, so that S and Q belong to unmodified counts.
    Interrupts and self-test are off, the clock is the internal one.
    """
    values = dict.fromkeys(SETTING_NAMES, 0)
    values["FILTER"] = RATES_HZ.index(rate_hz)
    values["FIFO_SAMPLES"] = FIFO_ENTRIES_MAX
    values["RANGE"] = _RANGE_RESET_BITS | 1 + list(part.counts_per_g).index(range_g)
    values["POWER_CTL"] = MEASURE
    values["ACT_COUNT"] = 1  # its reset value; activity detection is off
    return bytes(values.values())


def filters(rate_hz: float) -> tuple[str, ...]:
    """The filters at an output data rate, as in DeviceInfo.

    Data sheets of the family: a fixed stage decimates to 4 kHz, a variable stage from there to
    the output data rate. Table "Digital filter group delay and profile", at ODR/4: the decimator is 3.44 dB down at
    4 kHz, 2.21 at 2 kHz, 1.92 at 1 kHz and 1.83 from 500 Hz on; with the analog filter 3.63, 2.26, 1.93 and 1.83 dB.
    The delay is 0.63 ms at 4 kHz, 1.78 ms at 1 kHz, 1.5 periods at low rates. Five means of two samples, two means over
    the decimation and a pure delay have these attenuations within 0.03 dB and these delays within 0.1 ms.

    Compared with table 10 of the ADXL355's data sheet and table 8 of the ADXL359's, which are the same; the ADXL357's
    was not compared.

    The text of the sheets states a stronger analog filter than these tables leave room for: 30 % down at 1.5 kHz, a
    sinc (ADXL355), or 50 %, a sinc3 (ADXL359), which is 0.3 % at 100 Hz. Up to 2 kHz the uncertainty of the second
    stage contains this difference. At 4 kHz there is no second stage: that of the first stage's frequencies is 30 %.

    The register table of the same data sheets calls ODR/4 the corner, where a filter would be 3 dB down. The standard
    uncertainty of the second stage's frequencies, 25 %, is so large that both statements lie within U.
    """
    decimation = round(RATES_HZ[0] / rate_hz)
    variable = f"sinc order=2 points={decimation} rate_hz={RATES_HZ[0]:g} u_rate_pct=25"
    u_fixed_pct = 5 if decimation > 1 else 30
    return (
        "lowpass order=1 corner_hz=4700 u_corner_pct=20",
        f"sinc order=5 points=2 rate_hz={2.0 * RATES_HZ[0]:g} u_rate_pct={u_fixed_pct}",
        *([variable] if decimation > 1 else []),
        f"delay delay_s={_LATE_S + 0.5 / rate_hz:.6g}",
    )


def spoilt_samples(rate_hz: float) -> tuple[int, int]:
    """How many samples before and behind an indication at the end of the range are spoilt, too.

    Data sheets, "Overrange protection": over range the drive of the sensor stops for 0.5 ms and the output floats to
    zero. The filters spread this over the length of their impulse response: two means over the decimation to the rate,
    and at most 1.4 ms of the fixed stage and the analog filter (a sinc3 with its first zero at 4.1 kHz, as the text of
    the ADXL359's sheet has it).
    """
    length_s = 2.0 * (1.0 / rate_hz - 1.0 / RATES_HZ[0]) + _FIXED_FILTERS_S
    return math.ceil(length_s * rate_hz), math.ceil((length_s + _DRIVE_STOPS_S) * rate_hz)


def self_test(part: Part, rate_hz: float) -> SelfTest:
    """Self-test with the bits ST1 and ST2: the change is that by ST2 while ST1 is set; both may be set while measuring.

    ADXL355 data sheet: 0.1 to 0.6 g in x and y, 0.5 to 3.0 g in z (typically 0.3, 0.3 and 1.5 g), at any range; Zephyr
    (adxl355.c) does the same. ADXL357 data sheet: 0.5 to 3.0 g in z (typically 1.25 g) and no limits for x and y; the
    ADXL359's specifies z alone, too. There any change from 0.01 to 3.0 g passes in x and y. The public drivers of
    plasmapper use the same limits for both parts. The noise is that of a bandwidth of a quarter of the rate.
    """
    noise_g = part.noise_g * (rate_hz / 4) ** 0.5
    return SelfTest(
        before=((SELF_TEST, _ST1),),
        writes=((SELF_TEST, _ST1 | _ST2),),
        settle_s=0.1,
        low_g=part.self_test_low_g,
        high_g=part.self_test_high_g,
        noise_g=(noise_g, noise_g, noise_g),
        source=f"{part.kind} data sheet, self-test output change",
    )


def temperature(part: Part, data: bytes) -> tuple[int, float]:
    """Raw value (12 bits) and temperature in degC from the registers TEMP2 and TEMP1.

    The data sheet's nominal line is used; the intercept differs by some degC from part to part.
    """
    raw = (data[0] & 0x0F) << 8 | data[1]
    return raw, 25.0 + (raw - part.temperature_intercept) / -9.05


def triples(data: bytes) -> FifoSamples:
    """Find the samples (x, y, z) in FIFO entries of 3 bytes each by the X marker.

    A sample is an entry with the X marker, two entries without it (Y, Z), and then the next X marker or the end of
    `data`. `data` must not hold entries that the device marks as empty (see `without_empty`).
    """
    entries = np.frombuffer(data, np.uint8).reshape(-1, 3)
    n = len(entries)
    x = (entries[:, 2] & _X_MARK).astype(bool)
    whole = np.flatnonzero(x[:-2] & ~x[1:-1] & ~x[2:] & np.append(x, True)[3:])
    rest = n - 1 if n and x[-1] else n - 2 if n > 1 and x[-2] else n
    breaks = np.flatnonzero(np.diff(whole, prepend=-3) != 3).tolist()
    if rest != (whole[-1] + 3 if len(whole) else 0):
        breaks.append(len(whole))
    words = (entries[:, 0].astype(np.int32) << 12) | (entries[:, 1].astype(np.int32) << 4) | (entries[:, 2] >> 4)
    signed = (words ^ 0x80000) - 0x80000
    return FifoSamples(
        counts=signed[whole[:, None] + np.arange(3)],
        last=whole + 2,
        breaks=breaks,
        dropped=rest - 3 * len(whole),
        rest=data[3 * rest :],
    )


def without_empty(data: bytes) -> bytes:
    """Remove the entries that the device marks as read from an empty FIFO."""
    if not data[2::3].translate(None, _FULL):  # numpy takes fifteen times as long for the few entries of a poll
        return data
    entries = np.frombuffer(data, np.uint8).reshape(-1, 3)
    return bytes(entries[(entries[:, 2] & _EMPTY) == 0].tobytes())
