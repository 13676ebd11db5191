"""Bags of ROS 1 (.bag), version 2.0, whole or cut. The index is not used, so a bag without one is read too.

The records are those of the ROS wiki, Bags/Format/2.0. Lengths are checked before they are used.
"""

from __future__ import annotations

import bz2
import os
import struct
from collections.abc import Iterator
from typing import BinaryIO

from agent.config.files import open_file
from agent.reading.bag import MOST_DEFINITION, Bag, BagChannel, BagMessage
from agent.reading.source import TableError
from agent.recording.limits import BYTES_PER_MESSAGE, CHUNK_LIMIT, MESSAGES_FIXED, most_unpacked

BEGIN = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, CHUNK, CONNECTION = 2, 3, 5, 7  # kinds of records (op)
LONGEST_HEADER = 1 << 16  # bytes
_LENGTH = struct.Struct("<I")
Header = dict[bytes, bytes]


class _FaultError(Exception):
    """The file cannot be read from byte `at` on."""

    def __init__(self, at: int, reason: str) -> None:
        super().__init__(reason)
        self.at = at


class Ros1Bag(Bag):
    """A bag of ROS 1."""

    def messages(self) -> Iterator[BagMessage]:
        """Yield the messages. Raises TableError."""
        self.said, unknown, index_at = [], 0, 0
        with open_file(self.path) as file:
            size = os.fstat(file.fileno()).st_size
            if file.read(len(BEGIN)) != BEGIN:
                raise TableError(f"{self.path}: only bags of version 2.0 are read; write it anew with `rosbag fix`")
            try:
                for at, header, body in _parts(file, size):
                    kind, number = _number(header, b"op", 1), _number(header, b"conn", 4)
                    if kind == BAG_HEADER:
                        index_at = _number(header, b"index_pos", 8)
                    elif kind == CONNECTION:
                        self._connected(number, header, _fields(at, body))
                    elif kind == MESSAGE and number in self.channels and len(header.get(b"time", b"")) == 8:
                        seconds, ns = struct.unpack("<II", header[b"time"])
                        yield BagMessage(number, 10**9 * seconds + ns, 10**9 * seconds + ns, body)
                    else:
                        unknown += kind == MESSAGE
                if index_at <= 0:
                    self.cut(size, size, "the recorder did not close it")
            except _FaultError as fault:
                self._ended(size, index_at, fault)
        self.undeclared(unknown)

    def _connected(self, number: int, header: Header, told: Header) -> None:
        """Keep a connection as a channel."""
        texts = [header.get(b"topic", b""), told.get(b"type", b""), told.get(b"message_definition", b"")]
        topic, kind, definition = (text[:MOST_DEFINITION].decode("utf-8", "replace") for text in texts)
        self.declare(number, BagChannel(topic, kind, "ros1msg", definition, "ros1"))

    def _ended(self, size: int, index_at: int, fault: _FaultError) -> None:
        """Say that the file is cut, or raise TableError where it is damaged: its index is in it."""
        if 0 < index_at < size:
            raise TableError(
                f"{self.path}, byte {fault.at}: {fault}; the file is damaged: record it anew, or save what is "
                "whole with `rosbag reindex`"
            )
        self.cut(fault.at, size, str(fault))


def _number(header: Header, name: bytes, size: int) -> int:
    """A number of a header, -1 where it is not there."""
    value = header.get(name, b"")
    return int.from_bytes(value, "little") if len(value) == size else -1


def _fields(at: int, data: bytes) -> Header:
    """The fields of a header. Raises _FaultError."""
    found: Header = {}
    offset = 0
    while offset < len(data):
        (length,) = _LENGTH.unpack_from(data.ljust(offset + 4, b"\xff"), offset)
        name, equals, value = data[offset + 4 : offset + 4 + length].partition(b"=")
        if length > len(data) - offset - 4 or not equals:
            raise _FaultError(at, "the fields of a record do not agree with its size")
        found[name] = value
        offset += 4 + length
    return found


def _parts(file: BinaryIO, size: int) -> Iterator[tuple[int, Header, bytes]]:
    """Yield place, header and content of the bag's header, connections and messages, those of chunks too.

    Raises _FaultError.
    """
    at, unpacked, messages = len(BEGIN), 0, 0
    while at < size:
        begin = file.read(_LENGTH.size)
        head = file.read(min(LONGEST_HEADER, int.from_bytes(begin, "little")) + _LENGTH.size)
        header, length = _record(at, begin + head)
        there = size - at - len(begin) - len(head)
        kind = _number(header, b"op", 1)
        if kind == CHUNK:
            body = file.read(min(length, there, CHUNK_LIMIT))
            data = _unpacked(at, header, body, most_unpacked(at + len(body)) - unpacked)
            unpacked += len(data)
            for part in _inside(at, data, whole=len(body) == length):
                messages += 1
                if messages > MESSAGES_FIXED + (at + length) // BYTES_PER_MESSAGE:
                    raise _FaultError(at, f"there are more than {messages - 1} messages up to here")
                yield part
        if length > min(there, CHUNK_LIMIT):
            raise _FaultError(at, f"the {length} bytes of a record reach beyond the end of the file, or are too many")
        if kind in (MESSAGE, BAG_HEADER, CONNECTION):
            yield at, header, file.read(length)
        at += len(begin) + len(head) + length
        file.seek(at)


def _record(at: int, head: bytes) -> tuple[Header, int]:
    """The header of a record and the length of its content, from its first bytes. Raises _FaultError."""
    (length,) = _LENGTH.unpack_from(head.ljust(4, b"\xff"))
    if length > LONGEST_HEADER or len(head) < length + 2 * _LENGTH.size:
        raise _FaultError(at, "the file ends here, or no record begins here")
    header = _fields(at, head[4 : 4 + length])
    if _number(header, b"op", 1) < 0:
        raise _FaultError(at, "a record does not say of which kind it is")
    return header, _LENGTH.unpack_from(head, 4 + length)[0]


def _inside(at: int, data: bytes, whole: bool) -> Iterator[tuple[int, Header, bytes]]:
    """Yield what is in a chunk; of one that is cut, what is before the cut. Raises _FaultError."""
    offset = 0
    while offset < len(data):
        (length,) = _LENGTH.unpack_from(data.ljust(offset + 4, b"\xff"), offset)
        try:
            header, size = _record(at, data[offset : offset + min(length, LONGEST_HEADER) + 2 * _LENGTH.size])
        except _FaultError:
            if whole:
                raise
            return
        offset += length + 2 * _LENGTH.size
        if size > len(data) - offset:
            if whole:
                raise _FaultError(at, "a message is longer than its chunk")
            return
        yield at, header, data[offset : offset + size]
        offset += size


def _unpacked(at: int, header: Header, body: bytes, allowed: int) -> bytes:
    """The content of a chunk, or as much of it as is there. Raises _FaultError."""
    compression, size = header.get(b"compression"), _number(header, b"size", 4)
    if size > min(allowed, CHUNK_LIMIT):
        raise _FaultError(at, f"a chunk announces {size} bytes, more than are allowed")
    try:
        if compression == b"none":
            return body
        if compression == b"bz2":
            return bz2.BZ2Decompressor().decompress(body, max_length=max(size, 0))
        if compression == b"lz4":
            import lz4.frame

            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(body, max_length=max(size, 0)))
    except (OSError, ValueError, EOFError, RuntimeError) as error:
        raise _FaultError(at, f"a chunk cannot be unpacked: {error}") from None
    raise _FaultError(at, f"a chunk has the compression {compression!r:.40}; none, bz2 and lz4 are read")
