"""Reads the records of an MCAP file one after the other from the beginning; checks every length before using it.

The summary at the end of the file is read as records like all others. It is never used to find data.
"""

from __future__ import annotations

import io
import struct
import threading
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO, Literal, cast

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from agent.recording.limits import MOST_MESSAGES_IN_CHUNK, UNPACKED_LIMIT, LimitExceededError, UsedLimits

MAGIC = b"\x89MCAP0\r\n"
_INCONSISTENT = "the lengths in it do not agree with its size"
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_KNOWN = frozenset(Opcode)
_READERS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.MESSAGE_INDEX: MessageIndex,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT: Attachment,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
    Opcode.DATA_END: DataEnd,
}


@dataclass(frozen=True, slots=True)
class FileFault:
    """What is wrong with a file, and where: `offset` in bytes; `record` is the kind of record that begins there.

    `torn`: the file only ends early, as after a power cut. `corrupt`: bytes in it differ from what was written.
    """

    kind: Literal["torn", "corrupt"]
    offset: int
    record: str
    reason: str

    def __str__(self) -> str:
        return f"byte {self.offset} ({self.record}): {self.reason}"


class FileRecordError(Exception):
    """A record cannot be read. `fault` says where and why."""

    def __init__(self, kind: Literal["torn", "corrupt"], offset: int, record: str, reason: str) -> None:
        self.fault = FileFault(kind, offset, record, reason)
        super().__init__(str(self.fault))


@dataclass(frozen=True, slots=True)
class FileRecord:
    """One record of the file: its offset in bytes, its opcode, and its content without the head of nine bytes."""

    offset: int
    opcode: int
    body: bytes

    @property
    def name(self) -> str:
        """Kind of the record, for messages."""
        return record_name(self.opcode)

    @property
    def end(self) -> int:
        """Offset of the first byte after the record."""
        return self.offset + _HEAD.size + len(self.body)

    @property
    def head(self) -> bytes:
        """The nine bytes before the body: opcode and length."""
        return _HEAD.pack(self.opcode, len(self.body))


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk, decompressed, with its CRC checked."""

    start_time: int
    end_time: int
    compression: str
    compressed_size: int
    data: bytes


@dataclass(frozen=True, slots=True)
class ChunkMessage:
    """One message of a chunk; `offset` within the unpacked chunk."""

    offset: int
    channel_id: int
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


def refusal(record: FileRecord, reason: str) -> FileRecordError:
    """A RecordError of kind `corrupt` for a record."""
    return FileRecordError("corrupt", record.offset, record.name, reason)


def record_name(opcode: int) -> str:
    """Kind of record for messages: `Chunk`, `MessageIndex`, ..."""
    if opcode not in _KNOWN:
        return f"opcode 0x{opcode:02x}"
    return Opcode(opcode).name.title().replace("_", "")


def walk(file: BinaryIO, size: int) -> Iterator[FileRecord]:
    """Yield every record of a file of `size` bytes, from the header to the footer. Raises RecordError at a fault."""
    magic = file.read(len(MAGIC))
    if magic != MAGIC:
        reason = "the file does not begin with the bytes of an MCAP file"
        raise _ended(file, size, 0, "magic", reason, early=MAGIC.startswith(magic))
    offset, opcode, budget = len(MAGIC), 0, UsedLimits()
    while opcode != Opcode.FOOTER:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size or not any(head):  # some file systems replace lost data with zeros
            raise _ended(file, size, offset, "end of file", "the file ends here without a footer")
        opcode, length = _HEAD.unpack(head)
        if opcode not in _KNOWN:
            raise FileRecordError("corrupt", offset, record_name(opcode), "MCAP has no such kind of record")
        if length > size - offset - _HEAD.size:
            reason = f"its {length} bytes reach beyond the end of the file"
            raise _ended(file, size, offset, record_name(opcode), reason)
        try:
            budget.take_record(opcode, length)
        except LimitExceededError as error:
            raise FileRecordError("corrupt", offset, record_name(opcode), str(error)) from None
        yield FileRecord(offset, opcode, file.read(length))
        offset += _HEAD.size + length
    end = file.read(len(MAGIC))
    if end != MAGIC:
        early = len(end) < len(MAGIC) and MAGIC.startswith(end)
        reason = "the file does not end with the bytes of an MCAP file"
        raise FileRecordError("torn" if early else "corrupt", offset, "magic", reason)
    if offset + len(MAGIC) != size:
        reason = f"{size - offset - len(MAGIC)} bytes follow the end of the MCAP data"
        raise FileRecordError("corrupt", offset + len(MAGIC), "end of file", reason)


def _ended(file: BinaryIO, size: int, offset: int, name: str, reason: str, *, early: bool = True) -> FileRecordError:
    """The error where reading cannot go on: torn; or corrupt where the file ends as a complete MCAP file does."""
    file.seek(max(0, size - len(MAGIC)))
    torn = early and (file.read() != MAGIC or size <= len(MAGIC))
    return FileRecordError("torn" if torn else "corrupt", offset, name, reason)


def parse(record: FileRecord) -> McapRecord:
    """A record as mcap's type (for chunks use `unpack`). Raises RecordError.

    A record is refused if writing the parsed record gives other bytes: lengths that disagree, a wrong CRC of an
    attachment, text that is not UTF-8, keys given twice.
    """
    kind = _READERS.get(record.opcode)
    if kind is None:
        raise refusal(record, "does not belong here")
    again = RecordBuilder()
    try:
        parsed: McapRecord = kind.read(ReadDataStream(io.BytesIO(record.body)))
        parsed.write(again)
    except (McapError, ValueError, OverflowError, struct.error) as error:
        reason = str(error) or _INCONSISTENT
        raise refusal(record, reason) from None
    if again.end() != record.head + record.body:
        raise refusal(record, _INCONSISTENT)
    return parsed


class _OfThread(threading.local):
    """What each thread has for itself: to make a decompressor takes four times as long as to decompress a chunk."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor()


_of_thread = _OfThread()


def unpack(record: FileRecord, budget: UsedLimits, *, crc_needed: bool = True) -> Chunk:
    """The content of a Chunk record, its sizes and CRC checked. Raises RecordError.

    `budget`: of this pass over the file. What exceeds it is not decompressed. `crc_needed` False: other programs may
    leave the CRC out.
    """
    try:
        return _unpack(record, budget, crc_needed)
    except (ValueError, zstandard.ZstdError) as error:
        raise refusal(record, str(error)) from None


def _unpack(record: FileRecord, budget: UsedLimits, crc_needed: bool) -> Chunk:
    body = record.body
    if len(body) < _CHUNK.size:
        raise ValueError("too short for a chunk")
    start_time, end_time, size, crc, name_length = _CHUNK.unpack_from(body)
    data_at = _CHUNK.size + name_length + 8
    if data_at > len(body) or int.from_bytes(body[data_at - 8 : data_at], "little") != len(body) - data_at:
        raise ValueError(_INCONSISTENT)
    compression = body[_CHUNK.size : data_at - 8]
    packed = memoryview(body)[data_at:]
    if compression and size > UNPACKED_LIMIT:
        raise ValueError(f"{size} bytes decompressed, more than the limit of {UNPACKED_LIMIT}")
    budget.take_chunk(record.end, size)
    if compression == b"zstd":
        # zstd allocates the size that the frame states, whatever limit it is given. So this size is checked first.
        if zstandard.frame_content_size(packed) != size:
            raise ValueError(f"the size in its zstd frame is not the {size} bytes that the chunk states")
        data = _of_thread.decompressor.decompress(packed, allow_extra_data=False)
    elif compression == b"":
        data = bytes(packed)
    else:
        raise ValueError(f"compression {compression!r} is neither zstd nor none")
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes after decompression, but the chunk states {size}")
    if (crc_needed or crc) and (crc == 0 or zlib.crc32(data) != crc):
        raise ValueError("its CRC does not fit its content")
    return Chunk(start_time, end_time, compression.decode(), len(packed), data)


def content(record: FileRecord, chunk: Chunk, budget: UsedLimits) -> Iterator[ChunkMessage | Schema | Channel]:
    """Yield messages, schemas and channels of `chunk`, unpacked from `record`, in order. Raises RecordError."""
    try:
        yield from _content(record, chunk, budget)
    except LimitExceededError as error:
        raise refusal(record, str(error)) from None


def _content(record: FileRecord, chunk: Chunk, budget: UsedLimits) -> Iterator[ChunkMessage | Schema | Channel]:
    data, offset, size = chunk.data, 0, len(chunk.data)
    messages = 0
    while offset < size:
        body_at = offset + _HEAD.size
        opcode, length = _HEAD.unpack_from(data, offset) if body_at <= size else (0, 0)
        if length > size - body_at:
            reason = f"{record_name(opcode)} at byte {offset} of the decompressed chunk reaches beyond the chunk's end"
            raise refusal(record, reason)
        if opcode == Opcode.MESSAGE and length >= _MESSAGE.size:
            channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, body_at)
            payload = data[body_at + _MESSAGE.size : body_at + length]
            messages += 1
            if messages > MOST_MESSAGES_IN_CHUNK:
                break
            yield ChunkMessage(offset, channel_id, sequence, log_time, publish_time, payload)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            budget.take_record(opcode, length)
            inside = FileRecord(record.offset, opcode, data[body_at : body_at + length])
            yield cast(Schema | Channel, parse(inside))
        else:
            reason = f"{record_name(opcode)} of {length} bytes is not allowed at byte {offset} of a decompressed chunk"
            raise refusal(record, reason)
        offset = body_at + length
    budget.take_messages(record.end, messages)
