"""Finds frames of fixed length in a stream of bytes by their first bytes and their checksum. Pure functions."""

from __future__ import annotations

import binascii
import functools
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

ByteOrder = Literal["little", "big"]
ChecksumName = Literal["none", "sum8", "xor8", "crc16-ccitt", "crc16-modbus"]
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


CHECKSUMS: Mapping[ChecksumName, tuple[int, Callable[[bytes], int]]] = {
    "none": (0, lambda _: 0),
    "sum8": (1, lambda data: sum(data) & 0xFF),
    "xor8": (1, lambda data: functools.reduce(operator.xor, data, 0)),
    "crc16-ccitt": (2, lambda data: binascii.crc_hqx(data, 0xFFFF)),
    "crc16-modbus": (2, _crc16_modbus),
}
"""Checksum name -> (number of bytes, function of the covered bytes)."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Frames of `length` bytes that begin with `start`.

    The checksum is in the last bytes of the frame and covers the bytes before it, from byte `checksum_from` on.
    """

    start: bytes
    length: int
    checksum: ChecksumName = "none"
    checksum_from: int = 0
    checksum_order: ByteOrder = "little"


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Result of `find`.

    - `frames` (N, length): the bytes of the frames.
    - `end` (N,): position in the data after each frame.
    - `slipped` (N + 1,): whether there were bytes outside a frame before each frame, and after the last one.
    - `dropped`: number of bytes outside frames.
    - `rest`: bytes at the end that may be the beginning of a frame.
    """

    frames: NDArray[np.uint8]
    end: NDArray[np.int64]
    slipped: NDArray[np.bool_]
    dropped: int
    rest: bytes


def find(data: bytes, layout: Layout) -> Found:
    """Find all frames in `data`.

    If the checksum is wrong, the search continues one byte later, because the first bytes of a frame may also occur
    inside a frame.
    """
    width, checksum = CHECKSUMS[layout.checksum]
    covered = layout.length - width
    starts: list[int] = []
    slipped: list[bool] = []
    free = at = 0
    while (at := data.find(layout.start, at)) >= 0 and at + layout.length <= len(data):
        stated = int.from_bytes(data[at + covered : at + layout.length], layout.checksum_order)
        if checksum(data[at + layout.checksum_from : at + covered]) == stated:
            starts.append(at)
            slipped.append(at != free)
            free = at = at + layout.length
        else:
            at += 1
    rest_at = at if at >= 0 else _beginning(data, layout.start, free)
    place = np.array(starts, np.int64)
    frames = np.frombuffer(data, np.uint8)[place[:, None] + np.arange(layout.length)]
    dropped = rest_at - layout.length * len(starts)
    slipped.append(rest_at != free)
    return Found(frames, place + layout.length, np.array(slipped), dropped, data[rest_at:])


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
