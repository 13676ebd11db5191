"""Finds the results in a recording. Chunks without results are not decompressed: gigabytes take seconds.

Used to make a lost store again. What cannot be read is left out and named in `faults`; `fieldcal audit` tells why.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from agent.core.events import Result
from agent.recording.limits import UsedLimits, longest
from agent.recording.messages import MessageError, decode, is_result_topic
from agent.recording.reading import open_recording
from agent.recording.records import MAGIC, ChunkMessage, FileRecord, FileRecordError, content, parse, unpack

_HEAD = struct.Struct("<BQ")
_CHANNEL_ID = struct.Struct("<H")


@dataclass(slots=True)
class ScannedFile:
    """What is read from a recording without replaying it: results in order, metadata, and what could not be read.

    `messages`: of each result, the bytes that are stored of it.
    """

    results: list[Result] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # by name; of one name, the last record
    faults: list[str] = field(default_factory=list)


def scan(path: Path) -> ScannedFile:
    """Scan one recording, finished or not. Raises OSError."""
    found = ScannedFile()
    with open_recording(path) as file:
        _Scan(file, found).run()
    return found


def metadata_of(path: Path) -> dict[str, dict[str, str]]:
    """Only the metadata of a recording; empty where none can be read. Raises OSError."""
    found = ScannedFile()
    with open_recording(path) as file:
        _Scan(file, found).run(results=False)
    return found.metadata


class _Scan:
    def __init__(self, file: BinaryIO, found: ScannedFile) -> None:
        self._file = file
        self._found = found
        self._budget = UsedLimits()
        self._schemas: dict[int, str] = {}
        self._results: dict[int, str] = {}  # schema name by channel, of channels with results
        self._others: set[int] = set()

    def run(self, *, results: bool = True) -> None:
        chunk: tuple[int, int] | None = None  # offset and length of the last chunk, whose indexes are being read
        indexed: set[int] = set()
        for offset, opcode, length in self._heads():
            if opcode == Opcode.MESSAGE_INDEX and length >= _CHANNEL_ID.size:
                indexed |= {*_CHANNEL_ID.unpack(self._file.read(_CHANNEL_ID.size))}
                continue
            self._take_chunk(chunk, indexed)
            chunk, indexed = None, set()
            if opcode == Opcode.CHUNK and results:
                chunk = (offset, length)
            elif opcode == Opcode.METADATA:
                self._take_metadata(offset, length)
        self._take_chunk(chunk, indexed)

    def _heads(self) -> Iterator[tuple[int, int, int]]:
        """Yield (offset, opcode, length) of every record up to DataEnd; the file is then positioned after its head."""
        size = self._file.seek(0, 2)
        offset = len(MAGIC)
        while offset + _HEAD.size <= size:
            self._file.seek(offset)
            opcode, length = _HEAD.unpack(self._file.read(_HEAD.size))
            if opcode in (0, Opcode.DATA_END) or length > min(longest(opcode), size - offset - _HEAD.size):
                return
            yield offset, opcode, length
            offset += _HEAD.size + length

    def _record(self, offset: int, opcode: int, length: int) -> FileRecord:
        self._file.seek(offset + _HEAD.size)
        return FileRecord(offset, opcode, self._file.read(length))

    def _take_metadata(self, offset: int, length: int) -> None:
        try:
            metadata = parse(self._record(offset, Opcode.METADATA, length))
        except FileRecordError as error:
            self._found.faults.append(str(error))
            return
        if isinstance(metadata, Metadata):
            self._found.metadata[metadata.name] = metadata.metadata

    def _take_chunk(self, chunk: tuple[int, int] | None, indexed: set[int]) -> None:
        # A chunk that declares a channel also holds messages on it. So a chunk whose indexes name only channels that
        # are known to carry no results holds no results.
        if chunk is None or (indexed and indexed <= self._others):
            return
        record = self._record(chunk[0], Opcode.CHUNK, chunk[1])
        try:
            for part in content(record, unpack(record, self._budget), self._budget):
                self._take_part(part)
        except (FileRecordError, MessageError) as error:
            self._found.faults.append(str(error))

    def _take_part(self, part: ChunkMessage | Schema | Channel) -> None:
        if isinstance(part, Schema):
            self._schemas[part.id] = part.name
        elif isinstance(part, Channel):
            if is_result_topic(part.topic):
                self._results[part.id] = self._schemas.get(part.schema_id, "")
            else:
                self._others.add(part.id)
        elif part.channel_id in self._results:
            _, result = decode(self._results[part.channel_id], part.data)
            self._found.results.append(result)  # type: ignore[arg-type]
            self._found.messages.append(part.data)
