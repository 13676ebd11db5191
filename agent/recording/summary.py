"""Derives from the data section of an MCAP file what its summary must contain."""

from __future__ import annotations

from typing import Any

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from agent.recording.limits import UsedLimits
from agent.recording.records import ChunkMessage, FileRecord, content, refusal, unpack
from agent.recording.results_chain import FILE_METADATA, PREVIOUS_RESULTS, ResultsChain

KINDS = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
)


class DerivedSummary:
    """Takes the records of a data section in order; `expected(kind)` gives the records the summary must then hold.

    Every method may raise RecordError, where a record contradicts the ones before it.
    """

    def __init__(self) -> None:
        self._budget = UsedLimits()
        self.messages = 0
        self.results = ResultsChain()  # of the results so far
        self.chunks: list[ChunkIndex] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._start_time = self._end_time = 0
        # Message indexes that must follow the last chunk, by channel; None where this chunk is damaged.
        self._awaited: dict[int, list[tuple[int, int]]] | None = {}

    def add_chunk(self, record: FileRecord) -> None:
        """Take a Chunk record: decompress it and read the records in it."""
        self._awaited = None  # until the chunk is known to be intact
        chunk = unpack(record, self._budget)
        times: list[int] = []
        messages: list[tuple[str, bytes]] = []
        awaited: dict[int, list[tuple[int, int]]] = {}
        for part in content(record, chunk, self._budget):
            if isinstance(part, ChunkMessage):
                if part.channel_id not in self._channels:
                    raise refusal(record, f"message on channel {part.channel_id}, which no record before it declares")
                times.append(part.log_time)
                awaited.setdefault(part.channel_id, []).append((part.log_time, part.offset))
                self._counts[part.channel_id] = self._counts.get(part.channel_id, 0) + 1
                messages.append((self._channels[part.channel_id].topic, part.data))
            else:
                self._declare(record, part)
        start, end = min(times, default=0), max(times, default=0)
        if (start, end) != (chunk.start_time, chunk.end_time):
            raise refusal(record, "its start and end times are not those of its messages")
        if times:
            self._start_time = min(start, self._start_time) if self.messages else start
            self._end_time = max(end, self._end_time)
        self.messages += len(times)
        for topic, data in messages:
            self.results.add(topic, data)
        index = ChunkIndex(
            chunk_length=record.end - record.offset,
            chunk_start_offset=record.offset,
            compression=chunk.compression,
            compressed_size=chunk.compressed_size,
            message_end_time=end,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=start,
            uncompressed_size=len(chunk.data),
        )
        self.chunks.append(index)
        self._awaited = awaited

    def _declare(self, record: FileRecord, part: Schema | Channel) -> None:
        known: dict[int, Any] = self._schemas if isinstance(part, Schema) else self._channels
        if known.setdefault(part.id, part) != part:
            raise refusal(record, f"{type(part).__name__} {part.id} is declared twice, with different content")
        if isinstance(part, Channel) and part.schema_id not in self._schemas:
            raise refusal(record, f"channel {part.topic} has schema {part.schema_id}, which no record before declares")

    def add_message_index(self, record: FileRecord, index: MessageIndex) -> None:
        """Take one of the message indexes after a chunk."""
        if self._awaited is None:
            return
        if self._awaited.pop(index.channel_id, None) != index.records:
            raise refusal(record, f"does not agree with channel {index.channel_id} in the chunk before it")
        self.chunks[-1].message_index_offsets[index.channel_id] = record.offset
        self.chunks[-1].message_index_length += record.end - record.offset

    def end_of_indexes(self, record: FileRecord) -> None:
        """Take a record that is not a message index: all message indexes of the last chunk must be before it."""
        missing, self._awaited = sorted(self._awaited or ()), {}
        if missing:
            raise refusal(record, f"comes before the message index of channels {missing}")

    def awaited_indexes(self) -> list[MessageIndex]:
        """The message indexes of the last chunk that are still missing after it."""
        return [MessageIndex(channel_id, records) for channel_id, records in (self._awaited or {}).items()]

    def add_metadata(self, record: FileRecord, metadata: Metadata) -> None:
        """Take a Metadata record."""
        if metadata.name == FILE_METADATA:
            self.results = ResultsChain.of_text(metadata.metadata.get(PREVIOUS_RESULTS, ""))
        self._metadata.append(MetadataIndex(record.offset, record.end - record.offset, metadata.name))

    def add_attachment(self, record: FileRecord, attachment: Attachment) -> None:
        """Take an Attachment record."""
        index = AttachmentIndex(
            offset=record.offset,
            length=record.end - record.offset,
            log_time=attachment.log_time,
            create_time=attachment.create_time,
            data_size=len(attachment.data),
            name=attachment.name,
            media_type=attachment.media_type,
        )
        self._attachments.append(index)

    def expected(self, kind: Opcode, groups: dict[int, list[tuple[FileRecord, Any]]]) -> list[Any]:
        """The records of one kind that the summary must hold. `groups`: the records that it does hold, by opcode."""
        if kind == Opcode.SUMMARY_OFFSET:
            return [_offset(offset, groups.get(offset.group_opcode)) for _, offset in groups.get(kind, [])]
        derived: dict[int, list[Any]] = {
            Opcode.SCHEMA: list(self._schemas.values()),
            Opcode.CHANNEL: list(self._channels.values()),
            Opcode.STATISTICS: [self._statistics()],
            Opcode.CHUNK_INDEX: self.chunks,
            Opcode.ATTACHMENT_INDEX: self._attachments,
            Opcode.METADATA_INDEX: self._metadata,
        }
        return derived[kind]

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self.chunks),
            message_count=self.messages,
            message_end_time=self._end_time,
            message_start_time=self._start_time,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _offset(present: SummaryOffset, group: list[tuple[FileRecord, Any]] | None) -> SummaryOffset:
    """The correct SummaryOffset; for an empty group it names the place where the group would be."""
    if not group:
        return SummaryOffset(present.group_opcode, present.group_start, 0)
    start, end = group[0][0].offset, group[-1][0].end
    return SummaryOffset(present.group_opcode, start, end - start)
