"""Makes forged files as a careful forger would: their content is wrong, but every CRC in them is right."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable
from pathlib import Path

import zstandard
from mcap.writer import CompressionType, Writer

from agent.recording.limits import Budget
from agent.recording.messages import schema_data, schema_of
from agent.recording.records import MAGIC, Record, unpack, walk


def records(data: bytes) -> list[Record]:
    """All records of a file, which must be readable to its end."""
    return list(walk(io.BytesIO(data), len(data)))


def with_sums(data: bytes) -> bytes:
    """The file with the CRCs of data section and summary computed anew."""
    parts = records(data)
    end = next(record for record in parts if record.name == "DataEnd")
    crc = zlib.crc32(data[: end.offset])
    body = data[: end.offset + 9] + struct.pack("<I", crc) + data[end.end : parts[-1].offset + 25]
    return body + struct.pack("<I", zlib.crc32(body[end.end :])) + MAGIC


def with_changed_messages(data: bytes, old: bytes, new: bytes) -> bytes:
    """The file with `old` replaced by `new`, of the same length, in its chunks; all CRCs are right again."""
    assert len(old) == len(new)
    parts = [data[: len(MAGIC)]]
    for record in records(data):
        body = record.body
        if record.name == "Chunk":
            content = unpack(record, Budget()).data.replace(old, new)
            name = body[28 : 32 + int.from_bytes(body[28:32], "little")]
            packed = zstandard.compress(content) if name[4:] else content
            head = body[:16] + struct.pack("<QI", len(content), zlib.crc32(content)) + name
            body = head + struct.pack("<Q", len(packed)) + packed
        parts.append(struct.pack("<BQ", record.opcode, len(body)) + body)
    return with_sums(b"".join(parts) + MAGIC)


def write_messages(path: Path, messages: Iterable[tuple[str, int, bytes]]) -> None:
    """Write a valid file of messages (topic, sequence, data)."""
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, enable_data_crcs=True)
        writer.start()
        channels: dict[str, int] = {}
        for topic, sequence, data in messages:
            if topic not in channels:
                name = schema_of(topic)
                schema = writer.register_schema(name, "protobuf", schema_data(name))
                channels[topic] = writer.register_channel(topic, "protobuf", schema)
            writer.add_message(channels[topic], 0, data, 0, sequence)
        writer.finish()
