"""Registers of the ADXL355 and what its bytes mean: pure functions, no bus. Source: data sheet ADXL354/ADXL355."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

IDENTITY = bytes([0xAD, 0x1D, 0xED])  # Analog Devices, MEMS, ADXL355
DEVID, REVISION, STATUS, TEMPERATURE, FIFO_DATA = 0x00, 0x03, 0x04, 0x06, 0x11
FIRST_SETTING, FILTER, RANGE, POWER_CTL, RESET, SHADOW = 0x1E, 0x28, 0x2C, 0x2D, 0x2F, 0x50
SHADOW_BYTES = 5
RESET_CODE = 0x52
MEASURE = 0x00
OVERRUN = 0x04  # in STATUS
FIFO_ENTRIES_MAX = 96
SETTING_NAMES = (
    *("OFFSET_X_H", "OFFSET_X_L", "OFFSET_Y_H", "OFFSET_Y_L", "OFFSET_Z_H", "OFFSET_Z_L"),
    *("ACT_EN", "ACT_THRESH_H", "ACT_THRESH_L", "ACT_COUNT", "FILTER", "FIFO_SAMPLES"),
    *("INT_MAP", "SYNC", "RANGE", "POWER_CTL", "SELF_TEST"),
)
RATES_HZ = tuple(4000.0 / 2.0**code for code in range(11))  # by the code in FILTER
RANGE_CODES: Mapping[int, int] = {2: 1, 4: 2, 8: 3}
COUNTS_PER_G: Mapping[int, int] = {2: 256000, 4: 128000, 8: 64000}
STANDARD_GRAVITY_MPS2 = 9.80665
COUNTS_MIN, COUNTS_MAX = -(2**19), 2**19 - 1
_RANGE_RESET_BITS = 0x80  # I2C high-speed mode, set after a reset and left so
_X_MARK, _EMPTY = 0x01, 0x02  # in an entry's last byte


def settings(rate_hz: float, range_g: int) -> bytes:
    """Values of the registers FIRST_SETTING .. SELF_TEST while measuring.

    Offsets zero and high-pass filter off: S and Q are of untouched counts. No interrupts, internal clock, no self-test.
    """
    values = dict.fromkeys(SETTING_NAMES, 0)
    values["FILTER"] = RATES_HZ.index(rate_hz)
    values["FIFO_SAMPLES"] = FIFO_ENTRIES_MAX
    values["RANGE"] = _RANGE_RESET_BITS | RANGE_CODES[range_g]
    values["POWER_CTL"] = MEASURE
    values["ACT_COUNT"] = 1  # its reset value; activity detection is off
    return bytes(values.values())


def temperature(data: bytes) -> tuple[int, float]:
    """Raw 12 bits and degC from TEMP2, TEMP1. Nominal line; part to part its intercept differs by degrees."""
    raw = (data[0] & 0x0F) << 8 | data[1]
    return raw, 25.0 + (raw - 1885) / -9.05


@dataclass(frozen=True, slots=True, eq=False)
class Triples:
    """Whole triples of a run of FIFO entries.

    `counts` (N, 3) int32; `last` (N,) place of each one's Z entry; `breaks` samples before which entries were out of
    step (rising, may hold N); `dropped` entries that belong to no triple; `rest` bytes of a triple that has only begun.
    """

    counts: NDArray[np.int32]
    last: NDArray[np.int64]
    breaks: list[int]
    dropped: int
    rest: bytes


def triples(data: bytes) -> Triples:
    """Find the triples in FIFO entries (3 bytes each) by the X marker: X, two others (Y, Z), then X or the end.

    Entries that the device marks as empty must not be in `data` (see `without_empty`).
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
    return Triples(
        counts=signed[whole[:, None] + np.arange(3)],
        last=whole + 2,
        breaks=breaks,
        dropped=rest - 3 * len(whole),
        rest=data[3 * rest :],
    )


def without_empty(data: bytes) -> bytes:
    """Leave out the entries that the device marks as read from an empty FIFO."""
    entries = np.frombuffer(data, np.uint8).reshape(-1, 3)
    return bytes(entries[(entries[:, 2] & _EMPTY) == 0].tobytes())
