"""Makes forged files as a careful forger would: their content is wrong, but every CRC in them is right."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema
from mcap.writer import CompressionType, Writer

from agent.recording.limits import UsedLimits
from agent.recording.messages import schema_data, schema_of
from agent.recording.records import MAGIC, ChunkMessage, FileRecord, content, parse, unpack, walk
from agent.recording.signing import SIGNATURE_METADATA

Message = tuple[str, str, int, int, int, bytes]  # topic, schema, log time, publish time, sequence, data


def records(data: bytes) -> list[FileRecord]:
    """All records of a file, which must be readable to its end."""
    return list(walk(io.BytesIO(data), len(data)))


def with_sums(data: bytes) -> bytes:
    """The file with the CRCs of data section and summary computed anew."""
    parts = records(data)
    end = next(record for record in parts if record.name == "DataEnd")
    crc = zlib.crc32(data[: end.offset])
    body = data[: end.offset + 9] + struct.pack("<I", crc) + data[end.end : parts[-1].offset + 25]
    return body + struct.pack("<I", zlib.crc32(body[end.end :])) + MAGIC


@dataclass
class Unpacked:
    """What a file holds: its metadata records and its messages, in order. `boundaries`: ends of all records, bytes."""

    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    messages: list[Message] = field(default_factory=list)
    boundaries: list[int] = field(default_factory=list)

    @staticmethod
    def of(path: Path) -> Unpacked:
        """Read a file of this program."""
        found, budget = Unpacked(), UsedLimits()
        schemas: dict[int, str] = {}
        channels: dict[int, tuple[str, str]] = {}
        with open(path, "rb") as file:
            for one in walk(file, path.stat().st_size):
                found.boundaries.append(one.end)
                if one.opcode == Opcode.METADATA:
                    metadata = parse(one)
                    assert isinstance(metadata, Metadata)
                    found.metadata.append((metadata.name, metadata.metadata))
                for part in content(one, unpack(one, budget), budget) if one.opcode == Opcode.CHUNK else ():
                    if isinstance(part, Schema):
                        schemas[part.id] = part.name
                    elif isinstance(part, Channel):
                        channels[part.id] = part.topic, schemas[part.schema_id]
                    elif isinstance(part, ChunkMessage):
                        times = part.log_time, part.publish_time, part.sequence
                        found.messages.append((*channels[part.channel_id], *times, part.data))
        return found

    def write(self, path: Path) -> None:
        """Write the file; CRCs, indexes and summary are right. The signature stays as it was."""
        with open(path, "wb") as file:
            writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
            writer.start("", "fieldcal")
            last = [entry for entry in self.metadata if entry[0] == SIGNATURE_METADATA]
            for name, metadata in (entry for entry in self.metadata if entry not in last):
                writer.add_metadata(name, metadata)
            schemas: dict[str, int] = {}
            channels: dict[tuple[str, str], int] = {}
            for topic, schema, log_time, publish_time, sequence, data in self.messages:
                if schema not in schemas:
                    schemas[schema] = writer.register_schema(schema, "protobuf", schema_data(schema))
                if (topic, schema) not in channels:
                    channels[topic, schema] = writer.register_channel(topic, "protobuf", schemas[schema])
                writer.add_message(channels[topic, schema], log_time, data, publish_time, sequence)
            writer.flush()
            for name, metadata in last:
                writer.add_metadata(name, metadata)
            writer.finish()


def change_messages(path: Path, old: bytes, new: bytes) -> None:
    """Replace `old` by `new` in all messages of a file; it must be in one of them."""
    found = Unpacked.of(path)
    before = found.messages
    found.messages = [(*place, data.replace(old, new)) for *place, data in before]  # type: ignore[misc]
    assert found.messages != before
    found.write(path)


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
