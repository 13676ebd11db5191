"""Reads a recording: its events in order, each with the results recorded for it.

The file is read from its beginning, and every record is checked; the summary is not used. Where a power cut left an
incomplete record at the end, reading ends after the last good record.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO, cast

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from agent.config.files import open_file
from agent.core.events import Event, Output, RunStart
from agent.recording.limits import MOST_RESULTS, UsedLimits
from agent.recording.messages import MessageError, decode, topic_of
from agent.recording.records import (
    ChunkMessage,
    FileFault,
    FileRecord,
    FileRecordError,
    content,
    parse,
    refusal,
    unpack,
    walk,
)

REPAIR_METADATA = "fieldcal.repair"  # the metadata record of a file that a crash left open and a later start closed


@dataclass(slots=True)
class RecordedStep:
    """An event and the results recorded for it.

    `schema`, `data`: name of the event's message and its bytes. `complete`: something was recorded after the results,
    or the file was closed; otherwise results may be missing.
    """

    event_sequence: int
    event: Event
    schema: str
    data: bytes
    results: list[Output] = field(default_factory=list)
    complete: bool = False


class RecordingReader:
    """One pass over a recording. `fault` says afterwards why the pass ended early (None: it reached the footer).

    `good_bytes`: offset of the end of the last record that was read and understood. `repaired`: a crash left the file
    open, so that its last results may be missing. `undecoded`: the fault is a message that this program cannot decode,
    as another version may have written it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fault: FileFault | None = None
        self.good_bytes = 0
        self.repaired = False
        self.undecoded = False
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}

    def steps(self) -> Iterator[RecordedStep]:
        """Yield the events in recorded order. The first is a RunStart; event numbers have no gap. Raises OSError."""
        step: RecordedStep | None = None
        try:
            with open_recording(self.path) as file:
                for record, number, item, schema, data in self._items(file):
                    if isinstance(item, Output):
                        if step is None or number != step.event_sequence:
                            raise refusal(record, f"a result of event {number} does not follow that event")
                        if len(step.results) == MOST_RESULTS:
                            raise refusal(record, f"event {number} has more than {MOST_RESULTS} results")
                        step.results.append(item)
                        continue
                    self._check_order(record, step, number, item)
                    if step is not None:
                        step.complete = True
                        yield step
                    step = RecordedStep(number, item, schema, data)
        except FileRecordError as error:
            self.fault = error.fault
        if step is not None:
            step.complete = self.fault is None and not self.repaired
            yield step

    @staticmethod
    def _check_order(record: FileRecord, before: RecordedStep | None, number: int, event: Event) -> None:
        if isinstance(event, RunStart) != (before is None):
            where = "does not begin with a" if before is None else "has a second"
            raise refusal(record, f"the recording {where} RunStart")
        if before is not None and number != before.event_sequence + 1:
            expected = before.event_sequence + 1
            raise refusal(record, f"event {number} follows event {before.event_sequence}; expected event {expected}")

    def _items(self, file: BinaryIO) -> Iterator[tuple[FileRecord, int, Event | Output, str, bytes]]:
        """Yield (chunk record, event sequence, event or result, schema name, message) for every message."""
        budget = UsedLimits()
        for record in walk(file, os.fstat(file.fileno()).st_size):
            if record.opcode == Opcode.CHUNK:
                for part in content(record, unpack(record, budget), budget):
                    if isinstance(part, ChunkMessage):
                        yield record, *self._item(record, part)
                    elif isinstance(part, Schema):
                        self._schemas[part.id] = part
                    else:
                        self._channels[part.id] = part
            elif record.opcode == Opcode.METADATA:
                self.repaired |= cast(Metadata, parse(record)).name == REPAIR_METADATA
            elif record.opcode == Opcode.MESSAGE:
                raise refusal(record, "a message outside a chunk; a recording has messages only in chunks")
            self.good_bytes = record.end

    def _item(self, record: FileRecord, message: ChunkMessage) -> tuple[int, Event | Output, str, bytes]:
        channel = self._channels.get(message.channel_id)
        schema = self._schemas.get(channel.schema_id) if channel else None
        if channel is None or schema is None:
            raise refusal(record, f"message on channel {message.channel_id}, which no record before it declares")
        try:
            number, item = decode(schema.name, message.data)
        except MessageError as error:
            self.undecoded = True
            raise refusal(record, f"{channel.topic}: {error}") from None
        if topic_of(item) != channel.topic or number & 0xFFFFFFFF != message.sequence:
            raise refusal(record, f"{channel.topic}: the message says topic {topic_of(item)} and event {number}")
        return number, item, schema.name, message.data


def open_recording(path: Path) -> BufferedReader:
    """Open a recording for reading. Retention does not delete the file while it is open.

    Raises OSError, also where `path` is a pipe or a device: reading from one could wait or last for ever.
    """
    file = open_file(path)
    with contextlib.suppress(ImportError, OSError):  # the system has no such locks, or the file system
        import fcntl

        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    return file


def first_event(path: Path) -> RunStart | None:
    """The RunStart at the beginning of a recording; None where there is none or the file cannot be read."""
    try:
        step = next(RecordingReader(path).steps(), None)
    except OSError:
        return None
    return step.event if step is not None and isinstance(step.event, RunStart) else None
