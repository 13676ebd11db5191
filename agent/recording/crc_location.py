"""Locate a single changed byte in a long run of bytes, from its recorded and its computed CRC only."""

from __future__ import annotations

import zlib

# Bytes searched, from the end. Each byte searched matches by chance with probability 255 / 2**32: a longer search would
# name wrong places more often.
SEARCHED = 1 << 22


def changed_byte(recorded: int, computed: int, length: int) -> int | None:
    """Offset of the one byte whose change turns CRC `recorded` into `computed` over `length` bytes; None if none does.

    A CRC (here zlib.crc32) is linear. The exclusive-or of the two CRCs is the CRC, without its constants, of the
    changed bits followed by zero bytes up to the end. The search removes one zero byte after the other from this
    difference. At the offset of the changed byte the difference equals the CRC of a single byte.
    """
    remainder = recorded ^ computed
    for offset in range(length - 1, max(-1, length - 1 - SEARCHED), -1):
        if remainder in _ONE_BYTE:
            return offset
        # The top bytes of all table entries differ. So the top byte tells which entry the step for a zero byte used.
        index = _BY_TOP_BYTE[remainder >> 24]
        remainder = ((remainder ^ _TABLE[index]) << 8 | index) & 0xFFFFFFFF
    return None


def _entry(byte: int) -> int:
    """CRC remainder of one byte, without zlib's initial value and final inversion."""
    return zlib.crc32(bytes([byte])) ^ zlib.crc32(b"\0")


_TABLE = [_entry(byte) for byte in range(256)]
_ONE_BYTE = frozenset(_TABLE[1:])
_BY_TOP_BYTE = {entry >> 24: byte for byte, entry in enumerate(_TABLE)}
