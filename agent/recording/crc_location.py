"""Where in a long run of bytes one byte must have changed, told from nothing but the two CRCs."""

from __future__ import annotations

import zlib

SEARCHED = 1 << 22  # bytes searched from the end; more are likelier to match by chance (255 / 2**32 a byte)


def changed_byte(recorded: int, computed: int, length: int) -> int | None:
    """Offset of the one byte whose change turns CRC `recorded` into `computed` over `length` bytes; None if none does.

    A CRC (here zlib.crc32) is linear: the two differ by the CRC, without its constants, of the changed bits followed by
    zeros. Taking back one zero byte after the other, what one changed byte leaves shows up where that byte is.
    """
    remainder = recorded ^ computed
    for offset in range(length - 1, max(-1, length - 1 - SEARCHED), -1):
        if remainder in _ONE_BYTE:
            return offset
        # The top byte of a table entry is unique, so it tells which entry the forward step of a zero byte had used.
        index = _BY_TOP_BYTE[remainder >> 24]
        remainder = ((remainder ^ _TABLE[index]) << 8 | index) & 0xFFFFFFFF
    return None


def _entry(byte: int) -> int:
    """CRC remainder of one byte, without the constants that zlib puts before and after."""
    return zlib.crc32(bytes([byte])) ^ zlib.crc32(b"\0")


_TABLE = [_entry(byte) for byte in range(256)]
_ONE_BYTE = frozenset(_TABLE[1:])
_BY_TOP_BYTE = {entry >> 24: byte for byte, entry in enumerate(_TABLE)}
