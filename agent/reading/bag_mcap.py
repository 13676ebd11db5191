"""Bags in MCAP, as rosbag2 and others write them: with chunks and without, compressed with zstd or lz4, whole or cut.

The records are those of the MCAP specification (mcap.dev/spec). The summary is not used, so a file without one is
read too. Lengths are checked before they are used.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import BinaryIO

import zstandard
from mcap.opcode import Opcode

from agent.config.files import open_file
from agent.reading.bag import MOST_CHANNELS, MOST_DEFINITION, Bag, BagChannel, BagMessage
from agent.reading.source import TableError
from agent.recording.limits import BYTES_PER_MESSAGE, CHUNK_LIMIT, MESSAGES_FIXED, most_unpacked
from agent.recording.records import MAGIC, record_name

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
TAKEN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
PRIVATE = 0x80  # opcodes from here on belong to other programs
WINDOW = 1 << 27  # bytes, the largest window of zstd that is allotted
Part = tuple[int, int, memoryview]  # offset in the file, of its chunk if it is in one; opcode; content


class _FaultError(Exception):
    """The file cannot be read from byte `at` on."""

    def __init__(self, at: int, opcode: int | None, reason: str) -> None:
        super().__init__(reason if opcode is None else f"{record_name(opcode)}: {reason}")
        self.at = at


class McapBag(Bag):
    """A bag in MCAP."""

    def messages(self) -> Iterator[BagMessage]:
        """Yield the messages. Raises TableError."""
        self.said, unknown = [], 0
        schemas: dict[int, tuple[str, str, str]] = {}
        with open_file(self.path) as file:
            size = os.fstat(file.fileno()).st_size
            try:
                for at, opcode, body in _parts(file, size):
                    if opcode != Opcode.MESSAGE:
                        self._declared(at, opcode, body, schemas)
                        continue
                    if len(body) < _MESSAGE.size:
                        raise _FaultError(at, opcode, f"{len(body)} bytes are too short for a message")
                    number, _, log_time_ns, publish_time_ns = _MESSAGE.unpack_from(body)
                    if number in self.channels:
                        yield BagMessage(number, log_time_ns, publish_time_ns, bytes(body[_MESSAGE.size :]))
                    else:
                        unknown += 1
            except _FaultError as fault:
                self._ended(file, size, fault)
        self.undeclared(unknown)

    def _ended(self, file: BinaryIO, size: int, fault: _FaultError) -> None:
        """Say that the file is cut, or raise TableError where it is damaged: it ends as a complete file does."""
        file.seek(max(0, size - len(MAGIC)))
        if size > len(MAGIC) and file.read() == MAGIC:
            raise TableError(
                f"{self.path}, byte {fault.at} ({fault}); the file is damaged: record it anew, or save what is whole "
                "with `mcap recover`"
            )
        self.cut(fault.at, size, str(fault))

    def _declared(self, at: int, opcode: int, body: memoryview, schemas: dict[int, tuple[str, str, str]]) -> None:
        """Keep a schema or a channel."""
        try:
            if opcode == Opcode.SCHEMA:
                (number,) = struct.unpack_from("<H", body)
                name, language, definition = _texts(body, 2, 3)
                if len(schemas) < MOST_CHANNELS:
                    schemas[number] = name, language, definition
            else:
                number, schema = struct.unpack_from("<HH", body)
                topic, serial = _texts(body, 4, 2)
                self.declare(number, BagChannel(topic, *schemas.get(schema, ("", "", "")), serial))
        except struct.error:
            raise _FaultError(at, opcode, "the lengths in it do not agree with its size") from None


def _texts(body: memoryview, at: int, count: int) -> list[str]:
    """So many texts, each after its length. Raises struct.error."""
    found = []
    for _ in range(count):
        (length,) = struct.unpack_from("<I", body, at)
        (text,) = struct.unpack_from(f"{min(length, MOST_DEFINITION)}s", body, at + 4)
        found.append(text.decode("utf-8", "replace"))
        at += 4 + length
    return found


def _parts(file: BinaryIO, size: int) -> Iterator[Part]:
    """Yield the schemas, channels and messages of the file, those of chunks too. Raises _FaultError."""
    if file.read(len(MAGIC)) != MAGIC:
        raise _FaultError(0, None, "the file does not begin with the bytes of an MCAP file")
    at, unpacked, messages = len(MAGIC), 0, 0
    while True:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size or not any(head):  # some file systems replace lost data with zeros
            raise _FaultError(at, None, "the file ends here without a footer")
        opcode, length = _HEAD.unpack(head)
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        there = size - at - _HEAD.size
        _check_head(at, opcode, length, there)
        if opcode == Opcode.CHUNK:
            body = file.read(min(length, there, CHUNK_LIMIT))
            data, whole = _content(at, body, length, max(0, most_unpacked(at + len(body)) - unpacked))
            unpacked += len(data)
            for part in _inside(at, data, whole):
                messages += part[1] == Opcode.MESSAGE
                if messages > MESSAGES_FIXED + (at + length) // BYTES_PER_MESSAGE:
                    raise _FaultError(at, opcode, f"there are more than {messages - 1} messages up to here")
                yield part
        if length > there:
            told = "; what is whole of its content is read" if opcode == Opcode.CHUNK else ""
            raise _FaultError(at, opcode, f"its {length} bytes reach beyond the end of the file{told}")
        if opcode in TAKEN:
            yield at, opcode, memoryview(file.read(length))
        at += _HEAD.size + length
        file.seek(at)


def _check_head(at: int, opcode: int, length: int, there: int) -> None:
    """Check what the head of a record states; so many bytes are `there`. Raises _FaultError."""
    if not 0 < opcode < Opcode.DATA_END and opcode < PRIVATE:
        raise _FaultError(at, opcode, "MCAP has no such kind of record")
    if opcode in (*TAKEN, Opcode.CHUNK) and CHUNK_LIMIT < length <= there:
        raise _FaultError(at, opcode, f"its {length} bytes are more than the limit of {CHUNK_LIMIT}")


def _inside(at: int, data: bytes, whole: bool) -> Iterator[Part]:
    """Yield what is in a chunk; of one that is cut, what is before the cut. Raises _FaultError."""
    view, offset = memoryview(data), 0
    while offset + _HEAD.size <= len(data):
        opcode, size = _HEAD.unpack_from(data, offset)
        begin = offset + _HEAD.size
        if size > len(data) - begin or (opcode not in TAKEN and opcode < PRIVATE):
            break
        if opcode in TAKEN:
            yield at, opcode, view[begin : begin + size]
        offset = begin + size
    if whole and offset != len(data):
        raise _FaultError(at, Opcode.CHUNK, f"byte {offset} of its content is no record that fits into it")


def _content(at: int, body: bytes, length: int, allowed: int) -> tuple[bytes, bool]:
    """The content of a chunk, decompressed, and whether all of it is there. Raises _FaultError."""
    name_at = _CHUNK.size + 4
    if len(body) < name_at:
        return b"", False
    _, _, size, crc = _CHUNK.unpack_from(body)
    data_at = name_at + int.from_bytes(body[_CHUNK.size : name_at], "little") + 8
    compression, packed = body[name_at : data_at - 8], body[data_at:]
    whole = len(body) == length
    limit = min(size, allowed, CHUNK_LIMIT) if whole else min(allowed, CHUNK_LIMIT)
    try:
        if compression == b"":
            data = packed[:limit]
        elif compression == b"zstd":
            unpacker = zstandard.ZstdDecompressor(max_window_size=WINDOW)
            data = unpacker.stream_reader(BytesIO(packed), read_across_frames=True).read(limit)
        elif compression == b"lz4":
            import lz4.frame

            data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=limit)
        else:
            raise _FaultError(at, Opcode.CHUNK, f"compression {compression!r:.40} is none of zstd, lz4 and none")
    except (zstandard.ZstdError, RuntimeError) as error:
        raise _FaultError(at, Opcode.CHUNK, str(error)) from None
    if not whole:
        return data, False
    if size > limit or len(data) != size:
        told = f"{size} bytes are announced, {len(data)} are there or allowed"
        raise _FaultError(at, Opcode.CHUNK, f"its content does not have the size that it states: {told}")
    if crc and zlib.crc32(data) != crc:
        raise _FaultError(at, Opcode.CHUNK, "its CRC does not fit its content")
    return data, True
