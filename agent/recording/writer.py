"""Writes the recording: MCAP files `fieldcal-<sequence>.mcap`, each standing alone, in order of events.

One thread owns a Recorder. Nothing here raises for a disk that is full or failing: the file is given up where it stood,
`recording` turns false, and `wants_rotation` asks for a new RunStart some time later.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO, cast

from mcap.writer import CompressionType, Writer

from agent.events import Event, Result, RunStart
from agent.recording.messages import EVENTS_TOPIC, RESULT_TOPICS, encode, schema_data, schema_of, topic_of

log = logging.getLogger(__name__)

ACTIVE_SUFFIX = ".active"
FILE_METADATA = "fieldcal.file"
MAX_BYTES = 64 << 20  # bytes on disk; about 2.5 hours of two devices at 1 kHz, copied and hashed in a second
MAX_AGE_S = 3600.0  # s of event time; what an audit loses when a file is damaged
RETRY_S = 10.0  # s of event time after a failed file; a full disk is asked again, not hammered
_NAME = re.compile(r"fieldcal-(\d{6,})\.mcap(\.active)?")


class _HashedFile:
    """A new file, unbuffered, with the SHA-256 of what was written: what mcap's Writer needs of a stream.

    Unbuffered, since a buffer would be written once more on close, after an error.
    """

    def __init__(self, path: Path) -> None:
        self._file = open(path, "xb", buffering=0)  # noqa: SIM115 - closed by `close`
        self._sha256 = hashlib.sha256()
        self._size = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        self._sha256.update(data)
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Nothing is buffered."""

    def sync(self) -> None:
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()

    def hexdigest(self) -> str:
        return self._sha256.hexdigest()


class RecordingFile:
    """One file, from its RunStart to its footer. Every method may raise OSError; after one, only `abandon`."""

    def __init__(self, directory: Path, start: RunStart, topics: Iterable[str], previous: tuple[str, str]) -> None:
        self.final_path = directory / f"fieldcal-{start.file_sequence:06d}.mcap"
        self.path = self.final_path.with_name(self.final_path.name + ACTIVE_SUFFIX)
        self._stream = _HashedFile(self.path)
        self._unsynced = False
        stream = cast(IO[bytes], self._stream)  # all of it that the Writer uses
        self._writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        try:
            self._writer.start("", f"fieldcal/{start.versions.get('fieldcal', '')}")
            origin = {"previous_file": previous[0], "previous_sha256": previous[1]}
            self._writer.add_metadata(FILE_METADATA, {"file_sequence": str(start.file_sequence)} | origin)
            for topic in topics:
                self._channel(topic)
        except OSError:
            self.discard()
            raise

    @property
    def size(self) -> int:
        """Bytes on disk; up to one chunk more waits in memory."""
        return self._stream.tell()

    def append(self, topic: str, data: bytes, log_time: int, publish_time: int, sequence: int) -> None:
        """Add a message; it is on disk after the next `sync`."""
        # MCAP's sequence has 32 bits; the whole number is in the message.
        self._writer.add_message(self._channel(topic), log_time, data, publish_time, sequence & 0xFFFFFFFF)
        self._unsynced = True

    def sync(self) -> None:
        """Write the open chunk and wait until the disk has it."""
        if self._unsynced:
            self._writer.flush()
            self._stream.sync()
            self._unsynced = False

    def finish(self) -> str:
        """Close the file with summary and footer under its final name; returns its SHA-256 (hexadecimal)."""
        self._writer.finish()
        self._stream.sync()
        self._stream.close()
        self.path.rename(self.final_path)
        sync_directory(self.final_path.parent)
        return self._stream.hexdigest()

    def abandon(self) -> None:
        """Let go of the file as it is: after an error, writing on would tear a record in the middle of the file."""
        self._stream.close()

    def discard(self) -> None:
        """Remove a file that has not got as far as its RunStart: on a full disk one would be left at every attempt."""
        self._stream.close()
        self.path.unlink(missing_ok=True)

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            name = schema_of(topic)
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, "protobuf", schema_data(name))
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", self._schemas[name])
        return self._channels[topic]


class Recorder:
    """The recording of a gateway: takes events with their results in order, and keeps the files.

    `directory` must exist. `devices`, `sensors` name the channels that each file declares at its start (others are
    declared when they come). A file wants to be followed by the next beyond `max_bytes` or `max_age_s` of event time.
    """

    def __init__(
        self,
        directory: Path,
        devices: Sequence[str],
        sensors: Sequence[str],
        *,
        max_bytes: int = MAX_BYTES,
        max_age_s: float = MAX_AGE_S,
        retry_s: float = RETRY_S,
    ) -> None:
        self._directory = directory
        results = [f"/{sensor}/{what}" for sensor in sensors for what in RESULT_TOPICS.values()]
        self._topics = [EVENTS_TOPIC, *(f"/{device}/raw" for device in devices), *results]
        self._max_bytes = max_bytes
        self._max_age_ns = int(max_age_s * 1e9)
        self._retry_ns = int(retry_s * 1e9)
        self._file: RecordingFile | None = None
        self._previous: tuple[str, str] | None = None
        self._utc_minus_monotonic_ns = 0
        self._now_ns = self._since_ns = 0  # event time now; and when the file began, or failed
        self.fault = ""  # why nothing is recorded

    @property
    def recording(self) -> bool:
        """Whether what is given to `record` reaches a file."""
        return self._file is not None

    @property
    def path(self) -> Path | None:
        """The file being written."""
        return self._file.path if self._file else None

    @property
    def size_bytes(self) -> int:
        """Bytes of the file being written that are on disk."""
        file = self._file
        return file.size if file is not None else 0

    @property
    def next_file_sequence(self) -> int:
        """The number for the next RunStart: one above all files in the directory, finished or not."""
        return max((number for number, _ in recordings(self._directory)), default=0) + 1

    @property
    def wants_rotation(self) -> bool:
        """Whether the next event should be a RunStart: the file is full or old, or it is time to try again."""
        file = self._file  # once: another thread may ask
        age_ns = self._now_ns - self._since_ns
        if file is None:
            return age_ns >= self._retry_ns
        return age_ns >= self._max_age_ns or file.size >= self._max_bytes

    def record(self, event_sequence: int, event: Event, results: Sequence[Result]) -> bool:
        """Write an event and what came of it; with results, or for a RunStart, wait for the disk.

        A RunStart finishes the file before and begins the next. Returns whether it is in a file; where that is so and
        there are results, all of them and every event before them survive a power cut.
        """
        log_time, publish_time = self._stamp(event)
        try:
            messages = [(topic_of(item), encode(event_sequence, item)) for item in (event, *results)]
            if isinstance(event, RunStart):
                self._begin(event)
            if self._file is None:
                return False
            for topic, data in messages:
                self._file.append(topic, data, log_time, publish_time, event_sequence)
            if results or isinstance(event, RunStart):
                self._file.sync()
            if isinstance(event, RunStart):
                self._previous = (self._file.final_path.name, "")  # until it is finished
        except OSError as error:
            where = error.filename or self.path or self._directory
            if isinstance(event, RunStart) and self._file is not None:
                self._file.discard()
                self._file = None
            self._fail(f"{error.strerror or error} ({where})")
        except (ValueError, TypeError) as error:
            # This event has no form in a recording: the file ends before it, the next begins with a snapshot after it.
            self.close()
            self._fail(f"event {event_sequence} cannot be recorded: {error}")
        return self.recording

    def sync(self) -> None:
        """Bring what was recorded to the disk; cheap where nothing waits."""
        try:
            if self._file is not None:
                self._file.sync()
        except OSError as error:
            self._fail(f"{error.strerror or error} ({self.path})")

    def close(self) -> None:
        """Finish the file, if there is one."""
        if self._file is None:
            return
        try:
            digest = self._file.finish()
        except OSError as error:
            self._fail(f"{error.strerror or error} ({self.path})")
        else:
            self._previous = (self._file.final_path.name, digest)
            self._file = None

    def _begin(self, start: RunStart) -> None:
        self.close()
        previous = self._previous or _newest(self._directory)
        self._since_ns = self._now_ns
        self._file = RecordingFile(self._directory, start, self._topics, previous)
        sync_directory(self._directory)
        self.fault = ""

    def _fail(self, fault: str) -> None:
        if self._file is not None:
            self._file.abandon()
        self._file = None
        self._since_ns = self._now_ns
        if fault != self.fault:
            log.error("not recording: %s", fault)
        self.fault = fault

    def _stamp(self, event: Event) -> tuple[int, int]:
        """(UTC, monotonic) in ns for MCAP; without UTC, from the clocks of the last event that had both."""
        monotonic_ns = event.t_monotonic_ns
        utc_ns = getattr(event, "t_utc_ns", None)
        if utc_ns is None:
            utc_ns = monotonic_ns + self._utc_minus_monotonic_ns
        else:
            self._utc_minus_monotonic_ns = utc_ns - monotonic_ns
            self._now_ns = monotonic_ns
        return max(utc_ns, 0), max(monotonic_ns, 0)


def recordings(directory: Path) -> list[tuple[int, Path]]:
    """(file sequence, path) of every recording in a directory, finished or not, in order."""
    found = [(_NAME.fullmatch(path.name), path) for path in directory.iterdir()]
    return sorted((int(match[1]), path) for match, path in found if match)


def _newest(directory: Path) -> tuple[str, str]:
    """Name and SHA-256 of the newest recording; the hash is empty where it was never finished."""
    _, path = max(recordings(directory), default=(0, None))
    if path is None:
        return "", ""
    if path.suffix == ACTIVE_SUFFIX:
        return path.name.removesuffix(ACTIVE_SUFFIX), ""
    with open(path, "rb") as file:
        return path.name, hashlib.file_digest(file, "sha256").hexdigest()


def sync_directory(directory: Path) -> None:
    """Make the names in a directory durable."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
