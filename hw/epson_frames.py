"""Registers and frames of Epson's accelerometers and vibration sensors on a UART: pure functions, no port.

Sources: data sheet of the M-A352AD10, Rev. 20251023 (registers, scale, range, count, checksum, filters, timing);
Epson's py_esensorlib (uart_port.py, accl_fn.py, and for the M-A342 vib_fn.py and model/ma342vd10.py) and
accl_ros2_driver (accel_epsonUart.c: the checksum).

The data sheet of the M-A342 was not found. No source says by how much its count rises from sample to sample, nor over
which words its checksum goes: a frame with three numbers of 24 bits has an odd number of bytes. So the count's step is
found from the stream, and the checksum is not asked for.

Of the M-A552AR, which is an M-A352 behind RS-422, the sources disagree: py_esensorlib expects the product ID A552AR, a
tool for it (zenithtek) reads A352AD10. Both are taken; so are A342 and A542VR.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.frames import Layout, NumberType, numbers

# (window, address). A register has two bytes; the byte at the even address is the low one.
MODE, DIAGNOSIS, IDENTITY, GLOBAL = (0, 0x02), (0, 0x04), (0, 0x4C), (1, 0x0A)
SIGNAL, MISCELLANEOUS, SAMPLING, FILTER, UART, BURST, LONG_FILTER = (*((1, at) for at in (0, 2, 4, 6, 8, 0x0C, 0x1C)),)
OFFSETS = tuple((1, at) for at in range(0x2C, 0x38, 2))
ALARMS = tuple((1, at) for at in range(0x46, 0x4C, 2))
PRODUCT = tuple((1, at) for at in range(0x6A, 0x72, 2))
VERSION = (1, 0x72)
SERIAL_NUMBER = tuple((1, at) for at in range(0x74, 0x7C, 2))
NAMES: Mapping[tuple[int, int], str] = {
    SIGNAL: "SIG_CTRL",
    MISCELLANEOUS: "MSC_CTRL",
    SAMPLING: "SMPL_CTRL",
    FILTER: "FILTER_CTRL",
    UART: "UART_CTRL",
    BURST: "BURST_CTRL",
    LONG_FILTER: "LONGFILT_CTRL",
    **{register: f"OFFSET_{'XYZ'[i // 2]}A_{('HIGH', 'LOW')[i % 2]}" for i, register in enumerate(OFFSETS)},
    **{register: f"{'XYZ'[i]}ALARM" for i, register in enumerate(ALARMS)},
}
WINDOW_AT, MODE_HIGH = 0x7E, 0x03
START, STOP = 0x01, 0x02  # of the high byte of MODE
CONFIGURATION_MODE, NOT_READY, HARDWARE_ERRORS, FILTER_BUSY, OUTPUT_BUSY = 0x0400, 0x0400, 0x00E0, 0x0020, 0x0001
IDENTITY_VALUE = 0x5345
END = b"\r"

G = 1 << 24  # counts per g
METRE_PER_S = 1 << 22  # counts per m/s
RANGE_G = 15
COUNTS_HZ = 4000  # of the sample counter of an accelerometer: 250 us each
VELOCITY_HZ = 3000.0  # of velocities that are neither averaged nor peaks
RATE_CODES: Mapping[float, int] = {1000.0: 2, 500.0: 3, 200.0: 4, 100.0: 5, 50.0: 6}
FILTER_CODES: Mapping[str, int] = {
    "k64_fc83": 1, "k64_fc220": 2, "k128_fc36": 3, "k128_fc110": 4, "k128_fc350": 5,
    "k512_fc9": 6, "k512_fc16": 7, "k512_fc60": 8, "k512_fc210": 9, "k512_fc460": 10,
}  # fmt: skip
USUAL_FILTERS: Mapping[float, str] = {
    1000.0: "k512_fc460", 500.0: "k512_fc210", 200.0: "k512_fc60", 100.0: "k512_fc16", 50.0: "k512_fc9",
}  # fmt: skip
SLOWEST_HZ: Mapping[str, float] = {  # table 5.4 of the data sheet: a filter does not go with a lower rate
    "k64_fc83": 500.0, "k64_fc220": 1000.0, "k128_fc36": 200.0, "k128_fc110": 500.0, "k128_fc350": 1000.0,
    "k512_fc9": 50.0, "k512_fc16": 100.0, "k512_fc60": 200.0, "k512_fc210": 500.0, "k512_fc460": 1000.0,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Output:
    """What a family of sensors sends: `axes` are the positions of three numbers, `scale` counts per unit, `highest` the
    largest count, `burst` the contents of BURST_CTRL."""

    products: tuple[str, ...]  # beginnings of the product ID
    layout: Layout
    axes: tuple[int, int, int]
    kind: NumberType
    count_at: int
    scale: int
    highest: int
    burst: int


ACCELERATION = Output(
    products=("A352", "A552AR"),
    layout=Layout(b"\x80", 24, "sum16", 1, "big", END),
    axes=(7, 11, 15),
    kind="i32",
    count_at=19,
    scale=G,
    highest=RANGE_G * G,
    burst=0xC703,  # flags, temperature, x, y, z, count, checksum
)
VELOCITY = Output(
    products=("A342", "A542VR"),
    layout=Layout(b"\x80", 13, end=END),
    axes=(1, 4, 7),
    kind="i24",
    count_at=10,
    scale=METRE_PER_S,
    highest=(1 << 23) - 1,
    burst=0x0702,  # x, y, z, count
)


def filter_delay_s(name: str) -> float:
    """Group delay: half the length of a symmetrical filter at 4 kHz."""
    return (int(name.removeprefix("k").split("_")[0]) - 1) / 2 / COUNTS_HZ


def settings(output: Output, rate_hz: float, filter_name: str) -> dict[tuple[int, int], int]:
    """Register -> value. UART_CTRL has its low byte alone: the high one is the baud rate."""
    common = {MISCELLANEOUS: 0x0006, UART: 0x01, BURST: output.burst}  # no external trigger; sends by itself
    if output is VELOCITY:
        return common | {SIGNAL: 0x0E00}
    return common | {
        SIGNAL: 0x8E04,  # acceleration; bias stabilised against thermal shock, as at the factory
        SAMPLING: RATE_CODES[rate_hz] << 8,
        FILTER: FILTER_CODES[filter_name],
        LONG_FILTER: 0,
        **dict.fromkeys(OFFSETS, 0),
        **dict.fromkeys(ALARMS, RANGE_G << 8 | 256 - RANGE_G),  # values end at these
    }


def write(address: int, value: int) -> bytes:
    """The command that writes one byte."""
    return bytes([0x80 | address, value]) + END


def ask(address: int) -> bytes:
    """The command that reads a register of the window that is open."""
    return bytes([address, 0]) + END


def answer(heard: bytes, address: int) -> int | None:
    """The value of a register, from the newest answer in `heard`; None without one."""
    for at in range(len(heard) - 4, -1, -1):
        if heard[at] == address and heard[at + 3 : at + 4] == END:
            return int.from_bytes(heard[at + 1 : at + 3], "big")
    return None


def text(registers: list[int]) -> str:
    """Two characters a register; "" if they are not letters and digits."""
    found = struct.pack(f"<{len(registers)}H", *registers).rstrip(b"\0 \xff").decode("ascii", "replace")
    return found if found.isalnum() and found.isascii() else ""


def indications(frames: NDArray[np.uint8], output: Output) -> NDArray[np.float64]:
    """x, y, z (n, 3) in g or m/s, exactly as the device sends them."""
    columns = [numbers(frames, at, output.kind, "big") for at in output.axes]
    return np.column_stack(columns).astype(np.float64) / output.scale


def counts(frames: NDArray[np.uint8], output: Output) -> NDArray[np.uint16]:
    """The sample counter (n,)."""
    return np.asarray(numbers(frames, output.count_at, "u16", "big"), np.uint16)


def temperature(frame: NDArray[np.uint8]) -> tuple[int, float]:
    """Raw value and degC in the frame (24,) of an accelerometer."""
    (raw,) = struct.unpack(">i", frame[3:7].tobytes())
    return raw, 34.987 - 0.0037918 * raw


def faulty(frames: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(n,): whether frames of an accelerometer have the flag EA: an error that DIAG_STAT tells."""
    return np.asarray(frames[:, 2] & 1 == 1)
