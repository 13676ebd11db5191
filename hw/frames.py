"""Finds frames of fixed length in a stream of bytes by first and last bytes and a checksum. Pure functions."""

from __future__ import annotations

import binascii
import functools
import itertools
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

ByteOrder = Literal["little", "big"]
ChecksumName = Literal["none", "sum8", "xor8", "crc16-ccitt", "crc16-modbus", "sum16", "fletcher16"]
NumberType = Literal["u8", "i8", "u16", "i16", "i24", "u32", "i32", "f32"]
WIDTH: Mapping[NumberType, int] = {"u8": 1, "i8": 1, "u16": 2, "i16": 2, "i24": 3, "u32": 4, "i32": 4, "f32": 4}
_DTYPE = {"u8": "u1", "i8": "i1", "u16": "u2", "i16": "i2", "u32": "u4", "i32": "i4", "f32": "f4"}


def _crc16_modbus(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


def _sum16(data: bytes, order: ByteOrder) -> int:
    high, low = (data[::2], data[1::2]) if order == "big" else (data[1::2], data[::2])
    return (sum(high) * 256 + sum(low)) & 0xFFFF


def _fletcher16(data: bytes) -> int:
    return (sum(itertools.accumulate(data)) & 0xFF) << 8 | sum(data) & 0xFF


CHECKSUMS: Mapping[ChecksumName, tuple[int, Callable[[bytes, ByteOrder], int]]] = {
    "none": (0, lambda _, __: 0),
    "sum8": (1, lambda data, _: sum(data) & 0xFF),
    "xor8": (1, lambda data, _: functools.reduce(operator.xor, data, 0)),
    "crc16-ccitt": (2, lambda data, _: binascii.crc_hqx(data, 0xFFFF)),
    "crc16-modbus": (2, lambda data, _: _crc16_modbus(data)),
    "sum16": (2, _sum16),
    "fletcher16": (2, lambda data, _: _fletcher16(data)),
}
"""Checksum name -> (number of bytes, function of the covered bytes and the byte order of the checksum).

- `sum16`: sum of the 16-bit words, modulo 2^16. The words have the byte order of the checksum. Source: Epson's
  accl_ros2_driver, accel_epsonUart.c, where both are big-endian.
- `fletcher16`: two sums modulo 256 that begin with 0: a of the bytes, b of the values of a after each byte. In the
  order little a comes first. Source: MicroStrain's mip_sdk, mip_packet.c. Another variant is modulo 255: not this one.
"""


@dataclass(frozen=True, slots=True)
class Layout:
    """Frames of `length` bytes that begin with `start` and end with `end`.

    The checksum stands before `end` and covers the bytes before it, from byte `checksum_from` on.
    """

    start: bytes
    length: int
    checksum: ChecksumName = "none"
    checksum_from: int = 0
    checksum_order: ByteOrder = "little"
    end: bytes = b""

    @property
    def body(self) -> int:
        """Number of bytes before the checksum and `end`."""
        return self.length - len(self.end) - CHECKSUMS[self.checksum][0]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Result of a search for frames in `data`.

    - `start`, `end` (N,): first byte of each frame, and the position after it.
    - `rest_at`: position of the bytes at the end that may be the beginning of a frame.
    - `length`: bytes of each frame, where all have the same length.
    - `slipped_before`: whether the bytes before `data` were outside a frame.
    """

    data: bytes
    start: NDArray[np.int64]
    end: NDArray[np.int64]
    rest_at: int
    length: int = 0
    slipped_before: bool = False

    @property
    def frames(self) -> NDArray[np.uint8]:
        """The bytes (N, length) of the frames."""
        return np.asarray(np.frombuffer(self.data, np.uint8)[self.start[:, None] + np.arange(self.length)])

    @property
    def rest(self) -> bytes:
        """The bytes from `rest_at` on."""
        return self.data[self.rest_at :]

    @property
    def slipped(self) -> NDArray[np.bool_]:
        """(N + 1,): whether there are bytes outside a frame before each frame, and after the last one."""
        slipped = np.asarray(np.append(self.start, self.rest_at) != np.append(0, self.end))
        slipped[0] |= self.slipped_before
        return slipped

    @property
    def dropped(self) -> int:
        """Number of bytes outside frames."""
        return int(self.rest_at - (self.end - self.start).sum())


def find(data: bytes, layout: Layout) -> Found:
    """Find all frames in `data` that have a checksum.

    If a frame does not fit, the search continues one byte later, because the first bytes of a frame may also occur
    inside a frame.
    """
    width, checksum = CHECKSUMS[layout.checksum]
    closed, order = layout.body + width, layout.checksum_order
    starts: list[int] = []
    free = at = 0
    while (at := data.find(layout.start, at)) >= 0 and at + layout.length <= len(data):
        covered, stated = data[at + layout.checksum_from : at + layout.body], data[at + layout.body : at + closed]
        ends = data.startswith(layout.end, at + closed)
        if ends and checksum(covered, order) == int.from_bytes(stated, order):
            starts.append(at)
            free = at = at + layout.length
        else:
            at += 1
    place = np.array(starts, np.int64)
    rest_at = at if at >= 0 else _beginning(data, layout.start, free)
    return Found(data, place, place + layout.length, rest_at, layout.length)


def _beginning(data: bytes, start: bytes, free: int) -> int:
    """Position where `data` ends with the first bytes of a frame; the length of `data` if it does not."""
    for at in range(max(free, len(data) - len(start) + 1), len(data)):
        if start.startswith(data[at:]):
            return at
    return len(data)


def numbers(frames: NDArray[np.uint8], at: int, kind: NumberType, order: ByteOrder) -> NDArray[np.generic]:
    """The number at byte `at` of each frame (N, length), as (N,)."""
    raw = np.ascontiguousarray(frames[:, at : at + WIDTH[kind]])
    if kind == "i24":
        most = raw if order == "big" else raw[:, ::-1]
        words = most[:, 0].astype(np.int32) << 16 | most[:, 1].astype(np.int32) << 8 | most[:, 2]
        return (words ^ 0x800000) - 0x800000
    return raw.view(("<" if order == "little" else ">") + _DTYPE[kind])[:, 0]
