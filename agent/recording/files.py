"""The files of a recording: `fieldcal-<sequence>.mcap`; until the file is closed its name ends with `.active`."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import IO, cast

from mcap.writer import CompressionType, Writer

from agent.core.events import RunStart
from agent.recording.limits import UNPACKED_LIMIT, most_unpacked
from agent.recording.messages import schema_data, schema_of
from agent.recording.results_chain import EPOCH, FILE_METADATA, PREVIOUS_RESULTS, ResultsChain
from agent.recording.signing import SIGNATURE_METADATA, SignedStatement, Signer

LARGE = UNPACKED_LIMIT // 2  # bytes; the chunk of a larger message is not compressed, since a reader would refuse it
ACTIVE_SUFFIX = ".active"
_NAME = re.compile(r"fieldcal-(\d{1,18})\.mcap(\.active)?")
_LIKE = re.compile(r"\.mcap(\.active)?$", re.IGNORECASE)


class _HashedFile:
    """A new file that computes the SHA-256 of what is written; it has the methods that mcap's Writer calls.

    It is unbuffered: after an error, a buffered file would write its buffer once more when it is closed.
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
    """Writes one file, from its RunStart to its footer.

    Every method may raise OSError. After an OSError call `abandon` and no other method.
    `origin`: metadata written at the beginning of the file: name and SHA-256 of the previous file, the store's marks.
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
        self._gateway = f"{start.site}/{start.gateway}"
        self._number = start.file_sequence
        self._epoch = origin.get(EPOCH, "")
        self._previous_sha256 = origin.get("previous_sha256", "")
        self._results = ResultsChain.of_text(origin.get(PREVIOUS_RESULTS, ""))
        self.final_path = directory / recording_name(start.file_sequence)
        self.path = self.final_path.with_name(self.final_path.name + ACTIVE_SUFFIX)
        self._stream = _HashedFile(self.path)
        self._unsynced = False
        self._unpacked = 0  # bytes of all messages, without those that are not compressed
        stream = cast(IO[bytes], self._stream)  # it has all methods that the Writer calls
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
        """Bytes in the file; up to one further chunk is in memory."""
        return self._stream.tell()

    @property
    def full(self) -> bool:
        """Whether so much was compressed into so few bytes that a reader would soon refuse more, see limits."""
        return self._unpacked > most_unpacked(self.size) // 2

    def append(self, topic: str, data: bytes, log_time: int, publish_time: int, sequence: int) -> None:
        """Add a message; it is on disk after the next `sync`."""
        channel, large = self._channel(topic), len(data) > LARGE
        if large:
            self._writer.flush()
            self._compress(CompressionType.NONE)
        # MCAP's sequence has 32 bits only; the message itself holds the full number.
        self._writer.add_message(channel, log_time, data, publish_time, sequence & 0xFFFFFFFF)
        self._results.add(topic, data)
        if large:
            self._writer.flush()
            self._compress(CompressionType.ZSTD)
        else:
            self._unpacked += len(data)
        self._unsynced = True

    def _compress(self, compression: CompressionType) -> None:
        """Choose how the chunks from now on are compressed. The Writer has no public way for this."""
        self._writer._Writer__compression = compression  # type: ignore[attr-defined]

    def note(self, name: str, metadata: dict[str, str]) -> None:
        """Add a metadata record after all messages appended so far."""
        self._writer.flush()
        self._writer.add_metadata(name, metadata)
        self._unsynced = True

    def sync(self) -> None:
        """Write the open chunk and wait until it is on disk (fsync)."""
        if self._unsynced:
            self._writer.flush()
            self._stream.sync()
            self._unsynced = False

    def statement(self) -> SignedStatement:
        """What can be signed of the file: all bytes written so far. Call it after `sync` or `finish`."""
        return SignedStatement(
            self._gateway,
            self._epoch,
            self._number,
            self._previous_sha256,
            self._results.text,
            self._stream.tell(),
            self._stream.sha256().hex(),
        )

    def finish(self) -> None:
        """Close the file with summary and footer under its final name."""
        if self._signer is not None:
            self._writer.flush()
            self._writer.add_metadata(SIGNATURE_METADATA, self._signer.metadata(self.statement()))
        self._writer.finish()
        self._stream.sync()
        self._stream.close()
        self.path.rename(self.final_path)
        sync_directory(self.final_path.parent)

    def abandon(self) -> None:
        """Close the file as it is, without summary and footer.

        For use after a write error: writing further would leave a broken record in the middle of the file.
        """
        self._stream.close()

    def discard(self) -> None:
        """Delete a file that does not hold its RunStart yet. On a full disk each attempt would leave such a file."""
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
    """(file sequence, path) of every recording in a directory, finished or not, sorted by file sequence."""
    found = ((file_number(path.name), path) for path in directory.iterdir())
    return sorted((number, path) for number, path in found if number is not None)


def misnamed(directory: Path) -> list[tuple[int, Path]]:
    """(number, path) of files whose name is like that of a recording, but not the one that a recording has.

    `fieldcal-0000001.mcap` names 1, as `fieldcal-000001.mcap` does; a file `.mcap` that names no number has 0.
    """
    found = [path for path in directory.iterdir() if _LIKE.search(path.name) and file_number(path.name) is None]
    return sorted((int(match[1]) if (match := _NAME.fullmatch(path.name)) else 0, path) for path in found)


def recording_name(number: int) -> str:
    """The name of the closed recording with this number."""
    return f"fieldcal-{number:06d}.mcap"


def final_name(path: Path) -> str:
    """The name of a recording without `.active`: the name that it has after it is closed."""
    return path.name.removesuffix(ACTIVE_SUFFIX)


def file_number(name: str) -> int | None:
    """The number in the file name of a recording, finished or not; None where it is not such a name."""
    match = _NAME.fullmatch(name)
    number = int(match[1]) if match else 0
    return number if match and name == recording_name(number) + (match[2] or "") else None


def newest(directory: Path) -> tuple[str, str]:
    """Name and SHA-256 of the newest recording; the SHA-256 is "" where the file was never closed, both without one."""
    _, path = max(recordings(directory), default=(0, None))
    if path is None:
        return "", ""
    if path.suffix == ACTIVE_SUFFIX:
        return path.name.removesuffix(ACTIVE_SUFFIX), ""
    with open(path, "rb") as file:
        return path.name, hashlib.file_digest(file, "sha256").hexdigest()


def sync_directory(directory: Path) -> None:
    """Bring created, renamed and deleted names in a directory to the disk (fsync). Raises OSError."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
