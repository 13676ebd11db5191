"""Walks the records of an MCAP file from the front, trusting nothing: every length is checked before it is used.

The summary at the end of the file is walked like everything else, never looked up.
"""

from __future__ import annotations

import io
import struct
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

MAGIC = b"\x89MCAP0\r\n"
# Bytes of a record or an unpacked chunk, so that memory is bounded. Ours: 1 MiB and a snapshot, of which the largest
# that a configuration allows, at 10 kHz on six axes, has 76 MB.
RECORD_LIMIT = 128 << 20
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
class Fault:
    """What is wrong with a file, and where: `offset` in bytes, `record` the kind of record that begins there.

    `torn`: the file just ends early, as after a power cut; `corrupt`: what is there is not what was written.
    """

    kind: Literal["torn", "corrupt"]
    offset: int
    record: str
    reason: str

    def __str__(self) -> str:
        return f"byte {self.offset} ({self.record}): {self.reason}"


class RecordError(Exception):
    """Ends a walk; carries the Fault."""

    def __init__(self, kind: Literal["torn", "corrupt"], offset: int, record: str, reason: str) -> None:
        self.fault = Fault(kind, offset, record, reason)
        super().__init__(str(self.fault))


@dataclass(frozen=True, slots=True)
class Record:
    """One record of the file: where it begins, its opcode, and its bytes without the nine of the head."""

    offset: int
    opcode: int
    body: bytes

    @property
    def name(self) -> str:
        """Kind of the record, for people."""
        return record_name(self.opcode)

    @property
    def end(self) -> int:
        """Offset of the byte after it."""
        return self.offset + _HEAD.size + len(self.body)

    @property
    def head(self) -> bytes:
        """The nine bytes before the body: opcode and length."""
        return _HEAD.pack(self.opcode, len(self.body))


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk unpacked, its CRC checked."""

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


def refusal(record: Record, reason: str) -> RecordError:
    """A RecordError for a record that is there but wrong."""
    return RecordError("corrupt", record.offset, record.name, reason)


def record_name(opcode: int) -> str:
    """Kind of record for people: `Chunk`, `MessageIndex`.."""
    if opcode not in _KNOWN:
        return f"opcode 0x{opcode:02x}"
    return Opcode(opcode).name.title().replace("_", "")


def walk(file: BinaryIO, size: int) -> Iterator[Record]:
    """Every record of a file of `size` bytes, from the header to the footer. Raises RecordError where it goes wrong."""
    magic = file.read(len(MAGIC))
    if magic != MAGIC:
        raise _ended(file, size, 0, "magic", "the file does not begin as MCAP does", early=MAGIC.startswith(magic))
    offset, opcode = len(MAGIC), 0
    while opcode != Opcode.FOOTER:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size or not any(head):  # some file systems fill with zeros what they lost
            raise _ended(file, size, offset, "end of file", "no record follows")
        opcode, length = _HEAD.unpack(head)
        if opcode not in _KNOWN:
            raise RecordError("corrupt", offset, record_name(opcode), "no such kind of record")
        if length > size - offset - _HEAD.size:
            reason = f"its {length} bytes reach beyond the end of the file"
            raise _ended(file, size, offset, record_name(opcode), reason)
        if length > RECORD_LIMIT:
            raise RecordError("corrupt", offset, record_name(opcode), f"{length} bytes, more than {RECORD_LIMIT}")
        yield Record(offset, opcode, file.read(length))
        offset += _HEAD.size + length
    end = file.read(len(MAGIC))
    if end != MAGIC:
        early = len(end) < len(MAGIC) and MAGIC.startswith(end)
        raise RecordError("torn" if early else "corrupt", offset, "magic", "the file does not end as MCAP does")
    if offset + len(MAGIC) != size:
        raise RecordError("corrupt", offset + len(MAGIC), "end of file", f"{size - offset - 8} bytes follow the end")


def _ended(file: BinaryIO, size: int, offset: int, name: str, reason: str, *, early: bool = True) -> RecordError:
    """A walk that cannot go on: torn, unless the file has its end, so that it was once whole."""
    file.seek(max(0, size - len(MAGIC)))
    torn = early and (file.read() != MAGIC or size <= len(MAGIC))
    return RecordError("torn" if torn else "corrupt", offset, name, reason)


def parse(record: Record) -> McapRecord:
    """A record as mcap's type (chunks have `unpack`).

    Whatever would not be written again as the very same bytes is refused: lengths that disagree, a wrong CRC of an
    attachment, text that is no UTF-8, keys given twice. Raises RecordError.
    """
    kind = _READERS.get(record.opcode)
    if kind is None:
        raise refusal(record, "does not belong here")
    again = RecordBuilder()
    try:
        parsed: McapRecord = kind.read(ReadDataStream(io.BytesIO(record.body)))
        parsed.write(again)
    except (McapError, ValueError, OverflowError, struct.error) as error:
        reason = str(error) or "its parts do not add up"
        raise refusal(record, reason) from None
    if again.end() != record.head + record.body:
        raise refusal(record, "its parts do not add up")
    return parsed


def unpack(record: Record) -> Chunk:
    """The content of a Chunk record, its sizes and CRC checked. Raises RecordError."""
    try:
        return _unpack(record.body)
    except (ValueError, zstandard.ZstdError) as error:
        raise refusal(record, str(error)) from None


def _unpack(body: bytes) -> Chunk:
    if len(body) < _CHUNK.size:
        raise ValueError("too short for a chunk")
    start_time, end_time, size, crc, name_length = _CHUNK.unpack_from(body)
    data_at = _CHUNK.size + name_length + 8
    if data_at > len(body) or int.from_bytes(body[data_at - 8 : data_at], "little") != len(body) - data_at:
        raise ValueError("its parts do not add up")
    compression = body[_CHUNK.size : data_at - 8]
    packed = memoryview(body)[data_at:]
    if size > RECORD_LIMIT:
        raise ValueError(f"{size} bytes unpacked, more than {RECORD_LIMIT}")
    if compression == b"zstd":
        # zstd allocates what the frame announces, whatever limit it is given: so that is looked at first.
        if zstandard.frame_content_size(packed) != size:
            raise ValueError(f"its zstd frame announces other than {size} bytes")
        data = zstandard.ZstdDecompressor().decompress(packed, allow_extra_data=False)
    elif compression == b"":
        data = bytes(packed)
    else:
        raise ValueError(f"compression {compression!r} is neither zstd nor none")
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes unpacked, {size} announced")
    if crc == 0 or zlib.crc32(data) != crc:
        raise ValueError("its CRC does not fit its content")
    return Chunk(start_time, end_time, compression.decode(), len(packed), data)


def content(record: Record, chunk: Chunk) -> Iterator[ChunkMessage | Schema | Channel]:
    """Messages, schemas and channels of a chunk (`record` as unpacked) in order. Raises RecordError."""
    data, offset, size = chunk.data, 0, len(chunk.data)
    while offset < size:
        body_at = offset + _HEAD.size
        opcode, length = _HEAD.unpack_from(data, offset) if body_at <= size else (0, 0)
        if length > size - body_at:
            reason = f"{record_name(opcode)} inside, at {offset}, is too long"
            raise refusal(record, reason)
        if opcode == Opcode.MESSAGE and length >= _MESSAGE.size:
            channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, body_at)
            payload = data[body_at + _MESSAGE.size : body_at + length]
            yield ChunkMessage(offset, channel_id, sequence, log_time, publish_time, payload)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            inside = Record(record.offset, opcode, data[body_at : body_at + length])
            yield cast(Schema | Channel, parse(inside))
        else:
            reason = f"{record_name(opcode)} of {length} bytes inside, at {offset}"
            raise refusal(record, reason)
        offset = body_at + length
