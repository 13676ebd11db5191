"""The files of a recording: `fieldcal-<sequence>.mcap`, with `.active` behind it until it is closed."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import IO, cast

from mcap.writer import CompressionType, Writer

from agent.core.events import RunStart
from agent.recording.messages import schema_data, schema_of
from agent.recording.signing import SIGNATURE_METADATA, Signer

ACTIVE_SUFFIX = ".active"
FILE_METADATA = "fieldcal.file"
_NAME = re.compile(r"fieldcal-(\d{6,18})\.mcap(\.active)?")


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

    def sha256(self) -> bytes:
        return self._sha256.copy().digest()


class RecordingFile:
    """One file, from its RunStart to its footer. Every method may raise OSError; after one, only `abandon`.

    `origin` goes into the metadata at its beginning: the file before with its SHA-256, the store's marks.
    """

    def __init__(
        self,
        directory: Path,
        start: RunStart,
        topics: Iterable[str],
        origin: dict[str, str],
        signer: Signer | None = None,
    ) -> None:
        self._signer = signer
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

    def note(self, name: str, metadata: dict[str, str]) -> None:
        """Add a metadata record behind all that was appended."""
        self._writer.flush()
        self._writer.add_metadata(name, metadata)
        self._unsynced = True

    def sync(self) -> None:
        """Write the open chunk and wait until the disk has it."""
        if self._unsynced:
            self._writer.flush()
            self._stream.sync()
            self._unsynced = False

    def finish(self) -> str:
        """Close the file with summary and footer under its final name; returns its SHA-256 (hexadecimal)."""
        if self._signer is not None:
            self._writer.flush()
            signature = self._signer.metadata(self._stream.sha256(), self._stream.tell())
            self._writer.add_metadata(SIGNATURE_METADATA, signature)
        self._writer.finish()
        self._stream.sync()
        self._stream.close()
        self.path.rename(self.final_path)
        sync_directory(self.final_path.parent)
        return self._stream.sha256().hex()

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


def recordings(directory: Path) -> list[tuple[int, Path]]:
    """(file sequence, path) of every recording in a directory, finished or not, in order."""
    found = [(_NAME.fullmatch(path.name), path) for path in directory.iterdir()]
    return sorted((int(match[1]), path) for match, path in found if match)


def final_name(path: Path) -> str:
    """The name that a recording has, or will have, when it is closed."""
    return path.name.removesuffix(ACTIVE_SUFFIX)


def file_number(name: str) -> int | None:
    """The number in the name of a recording, finished or not; None where it is the name of none."""
    match = _NAME.fullmatch(name)
    return int(match[1]) if match else None


def newest(directory: Path) -> tuple[str, str]:
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
