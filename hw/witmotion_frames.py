"""Frames and registers of WitMotion's serial protocol: pure functions, no port.

Sources: WitMotion's WitStandardProtocol_JY901 (wit_c_sdk.c: frames, sum, writing and reading registers; REG.h: register
numbers and codes) and their protocol description (acceleration in 16 g / 32768, temperature in 0.01 degC: data sheets
WT901, WT901SDCL). The older JY61 and BWT61CL send the temperature of their MPU-6050, raw / 340 + 36.53; this module
has only the scale of the newer sensors.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hw.frames import Layout

LAYOUT = Layout(b"\x55", 11, "sum8")
TIME, ACCELERATION, REGISTERS = 0x50, 0x51, 0x5F  # second byte of a frame
OUTPUT, RATE, BAUD, OFFSET_X, OFFSET_Y, OFFSET_Z, BANDWIDTH, VERSION, KEY, NUMBER = (
    *(0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x1F, 0x2E, 0x69, 0x7F),
)
UNLOCK = 0xB588
TIME_AND_ACCELERATION = 0x03
RATE_CODES: Mapping[float, int] = {200.0: 0x0B, 100.0: 0x09, 50.0: 0x08, 20.0: 0x07, 10.0: 0x06}
BANDWIDTH_HZ: Mapping[int, float] = {0: 256, 1: 188, 2: 98, 3: 42, 4: 20, 5: 10, 6: 5}
COUNTS_PER_G = 2048
LIMITS = -(2**15), 2**15 - 1
NAMES: Mapping[int, str] = {
    OUTPUT: "RSW",
    RATE: "RRATE",
    OFFSET_X: "AXOFFSET",
    OFFSET_Y: "AYOFFSET",
    OFFSET_Z: "AZOFFSET",
    BANDWIDTH: "BANDWIDTH",
}
_DAY_MS = 86_400_000


def settings(rate_hz: float) -> dict[int, int]:
    """Register -> value: send time and acceleration, offsets zero, the widest filter of at most half the rate."""
    bandwidth = next(code for code, hz in BANDWIDTH_HZ.items() if hz <= rate_hz / 2)
    return {
        OUTPUT: TIME_AND_ACCELERATION,
        RATE: RATE_CODES[rate_hz],
        OFFSET_X: 0,
        OFFSET_Y: 0,
        OFFSET_Z: 0,
        BANDWIDTH: bandwidth,
    }


def write(register: int, value: int) -> bytes:
    """The command that writes `value` to a register."""
    return struct.pack("<BBBH", 0xFF, 0xAA, register, value)


def ask(register: int) -> bytes:
    """The command that reads a register and the three after it; the device answers with a REGISTERS frame."""
    return write(0x27, register)


def words(frame: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """The four unsigned 16-bit words of a frame (11,)."""
    return struct.unpack("<4H", frame[2:10].tobytes())


def counts(frames: NDArray[np.uint8]) -> NDArray[np.int32]:
    """x, y, z (n, 3) in acceleration frames (n, 11)."""
    return np.ascontiguousarray(frames[:, 2:8]).view("<i2").astype(np.int32)


def temperature(frame: NDArray[np.uint8]) -> tuple[int, float]:
    """Raw value and degC in an acceleration frame (11,)."""
    (raw,) = struct.unpack("<h", frame[8:10].tobytes())
    return raw, raw / 100.0


def milliseconds(frames: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Time of day (n,), ms, in time frames (n, 11), whose bytes are year, month, day, hour, minute, second, ms."""
    hour, minute, second = frames[:, 5:8].astype(np.int64).T
    within_s = frames[:, 8:10].astype(np.int64) @ np.array([1, 256])
    return np.asarray(((hour * 60 + minute) * 60 + second) * 1000 + within_s)


def steps(times_ms: NDArray[np.int64], rate_hz: float) -> NDArray[np.float64]:
    """Number of sample periods between neighbouring times (n - 1,); also right over midnight."""
    return np.asarray(np.round(np.diff(times_ms) % _DAY_MS * rate_hz / 1e3))
