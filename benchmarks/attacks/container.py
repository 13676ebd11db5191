"""Attacks on the records of the container."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

from mcap.opcode import Opcode

from agent.recording.records import FileRecordError
from benchmarks.attacks.site import Attack, Site, at
from tests.replay.forgery import records, with_sums


def record_bytes(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def attachment(name: str, content: bytes) -> bytes:
    text = b"".join(struct.pack("<I", len(each)) + each for each in (name.encode(), b"application/octet-stream"))
    body = struct.pack("<QQ", 0, 0) + text + struct.pack("<Q", len(content)) + content
    return record_bytes(Opcode.ATTACHMENT, body + struct.pack("<I", zlib.crc32(body)))


def inserted(make: Callable[[int, bytes], bytes]) -> Attack:
    """A record put between two records, at the last place behind the signature; the CRCs are right."""

    def attack(data: Path, _: Site, place: int) -> None:
        path = at(data, place)
        content = path.read_bytes()
        parts = records(content)
        end = next(one for one in parts if one.name == "DataEnd")
        ends = [one.end for one in parts if one.end <= end.offset]
        where = ends[place * (len(ends) - 1) // 9]
        extra = make(place, content)
        section = content[:where] + extra + content[where : end.offset]
        start, offset, _crc = struct.unpack("<QQI", content[-28:-8])
        summary = content[end.end : -28] + struct.pack("<QQ", start + len(extra), offset + len(extra))
        closed = section + record_bytes(Opcode.DATA_END, struct.pack("<I", zlib.crc32(section))) + summary
        path.write_bytes(closed + struct.pack("<I", zlib.crc32(summary)) + content[-8:])

    return attack


def unknown_record(place: int, _: bytes) -> bytes:
    return record_bytes((0x10, 0x20, 0x7F, 0x80, 0x81, 0xC0, 0xFE, 0xFF, 0x90, 0x10)[place], os.urandom(20 * place))


def torn(place: int, content: bytes) -> bytes:
    return attachment("torn" if place % 3 else "x", (b"", content[:5000], bytes(1 << 20))[place % 3])


def one_more(place: int, content: bytes) -> bytes:
    """A record of each kind for a second time."""
    kinds = list({one.name: one for one in records(content)}.values())
    part = kinds[place % len(kinds)]
    return content[part.offset : part.end]


def summary_edited(data: Path, _: Site, place: int) -> None:
    """A byte of index, statistics or offsets, with the CRC of the summary right."""
    path = at(data, place)
    content = bytearray(path.read_bytes())
    parts = records(bytes(content))
    end = next(one for one in parts if one.name == "DataEnd")
    where = end.end + (parts[-1].offset - end.end - 1) * place // 9
    content[where] ^= 0x40
    try:
        path.write_bytes(with_sums(bytes(content)))
    except FileRecordError:  # the records cannot be walked any longer
        path.write_bytes(content)
