"""Closes the files that a crash left open. All intact records stay unchanged, and a proper end is written after them.

The file is repaired in place, since the disk may be full. The incomplete bytes after the last intact record are
replaced by an attachment that contains them, a metadata record about the repair, the signature where there is a key,
and the summary.
"""

from __future__ import annotations

import hashlib
import logging
import os
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, DataEnd, Footer, Metadata, SummaryOffset

from agent.core.events import RunStart
from agent.recording.files import ACTIVE_SUFFIX, recordings, sync_directory
from agent.recording.head import begins_as_signed, head_beside
from agent.recording.integrity import check_integrity
from agent.recording.limits import UsedLimits
from agent.recording.reading import REPAIR_METADATA, RecordingReader, first_event
from agent.recording.records import MAGIC, FileRecord, FileRecordError, parse, unpack, walk
from agent.recording.results_chain import EPOCH, FILE_METADATA
from agent.recording.scan import metadata_of
from agent.recording.signing import SIGNATURE_METADATA, SignedStatement, Signer
from agent.recording.summary import KINDS, DerivedSummary

TAIL_ATTACHMENT = "torn"
UNSIGNED = "unsigned"  # in the metadata of the repair: why the gateway did not sign the file then
# Bytes. A crash damages only what was written after the last flush: one or two chunks. Where more data other than zeros
# follow a broken record, the damage has another cause. Such a file is not closed, since data after the damage may be
# readable.
TAIL_MAX = 8 << 20

_log = logging.getLogger(__name__)


def close_torn(directory: Path, signer: Signer | None = None, *, own: bool = False) -> None:
    """Close every `.active` file in `directory`. No process may be writing to one of them.

    With a `signer` they are signed as far as the gateway's head shows that the gateway began them; all of them where
    they are this process's `own`. A file that cannot be closed stays as it is; a warning in the log names it. Raises
    OSError where the directory cannot be read.
    """
    for _, path in recordings(directory):
        if path.name.endswith(ACTIVE_SUFFIX):
            try:
                _log.warning("%s", close_file(path, signer, own=own))
            except (OSError, FileRecordError) as error:
                _log.warning("%s was left unfinished and cannot be closed: %s", path, error)


def close_file(path: Path, signer: Signer | None = None, *, own: bool = False) -> str:
    """Close one file; return what was done, as a sentence. Raises OSError, or RecordError where data would be lost."""
    final = path.with_name(path.name.removesuffix(ACTIVE_SUFFIX))
    unsigned = uncovered(path, signer) if signer is not None and not own else ""
    sign = _signing(path, signer) if signer is not None and not unsigned else None
    if final.exists():
        raise FileExistsError(f"{final.name} exists already")
    with open(path, "r+b") as file:
        size = os.fstat(file.fileno()).st_size
        sound = _sound_part(file, size)
        torn = size - sound.length
        if sound.chunks == 0:
            path.unlink()
            sync_directory(path.parent)
            return f"{path} was left unfinished before its first event was written; the file is deleted"
        file.seek(0)
        if check_integrity(file, size).finished:
            torn = 0  # the file is complete; only its final name is missing
        else:
            _append(file, sound, size, sign, unsigned)
    path.rename(final)
    sync_directory(path.parent)
    said = f"{final} was left unfinished and is closed now; the last {torn} bytes were incomplete"
    return f"{said}; it is not signed, and an audit with the key refuses it: {unsigned}" if unsigned else said


def uncovered(path: Path, signer: Signer) -> str:
    """Why nothing shows that the gateway began an open recording; "" where its signed head does. Raises OSError.

    The gateway signs a head before it writes the second event, so a recording of one event needs none.
    """
    reader = RecordingReader(path)
    first, second = (next(steps := reader.steps(), None), next(steps, None))
    start = first.event if first is not None else None
    if not isinstance(start, RunStart):
        return "its first event cannot be read"
    head = head_beside(path, f"{start.site}/{start.gateway}", signer.known)
    if head is None:
        return "no head beside it names it, so anybody may have written it" if second is not None else ""
    return "" if begins_as_signed(path, head) else "its beginning is not the one that the gateway signed"


@dataclass(slots=True)
class _Sound:
    """The data section up to the first record that is not intact."""

    length: int
    crc: int
    sha256: Any
    derived: DerivedSummary
    chunks: int


Sign = Callable[[_Sound], dict[str, str]]


def _sound_part(file: BinaryIO, size: int) -> _Sound:
    sound = _Sound(0, 0, hashlib.sha256(), DerivedSummary(), 0)

    def keep(data: bytes) -> None:
        sound.length += len(data)
        sound.crc = zlib.crc32(data, sound.crc)
        sound.sha256.update(data)

    broken: FileRecordError | None = None
    goes_on = False  # an intact chunk follows the broken record: a crash does not cause that
    try:
        for record in walk(file, size):
            if broken is not None:
                goes_on = goes_on or (record.opcode == Opcode.CHUNK and _is_sound(record))
                continue
            if record.opcode == Opcode.DATA_END:
                break
            try:
                _take(sound.derived, record)
            except FileRecordError as error:
                broken = error
                continue
            keep(record.head + record.body if sound.length else MAGIC + record.head + record.body)
            sound.chunks = len(sound.derived.chunks)
    except FileRecordError as error:
        broken = broken or error
    if broken is not None and (goes_on or not _is_torn(file, sound, broken)):
        raise broken
    return sound


def _is_torn(file: BinaryIO, sound: _Sound, broken: FileRecordError) -> bool:
    """Whether a file that is broken there may be one that a crash has left."""
    corrupt = broken.fault.kind == "corrupt" and not sound.chunks
    return not corrupt and _ends_in_zeros(file, sound.length + TAIL_MAX)


def _is_sound(chunk: FileRecord) -> bool:
    try:
        unpack(chunk, UsedLimits())
    except FileRecordError:
        return False
    return True


def _ends_in_zeros(file: BinaryIO, offset: int) -> bool:
    """Whether all bytes from `offset` on are zeros; some file systems replace lost data with zeros."""
    file.seek(offset)
    while piece := file.read(1 << 20):
        if any(piece):
            return False
    return True


def _take(derived: DerivedSummary, record: FileRecord) -> None:
    if record.opcode == Opcode.CHUNK:
        derived.end_of_indexes(record)
        derived.add_chunk(record)
        return
    parsed: Any = parse(record)
    if record.opcode == Opcode.MESSAGE_INDEX:
        derived.add_message_index(record, parsed)
    elif record.opcode == Opcode.METADATA:
        derived.end_of_indexes(record)
        derived.add_metadata(record, parsed)
    elif record.opcode == Opcode.ATTACHMENT:
        derived.end_of_indexes(record)
        derived.add_attachment(record, parsed)


def _signing(path: Path, signer: Signer) -> Sign | None:
    """What gives the signature record of a file whose other records are closed; None where it cannot be signed."""
    start = first_event(path)
    if start is None:
        return None
    origin = metadata_of(path).get(FILE_METADATA, {})
    epoch, previous_sha256 = origin.get(EPOCH, ""), origin.get("previous_sha256", "")
    gateway, number = f"{start.site}/{start.gateway}", start.file_sequence
    if "\n" in gateway + epoch + previous_sha256:  # not a file of this program
        return None

    def sign(sound: _Sound) -> dict[str, str]:
        results, sha256 = sound.derived.results.text, sound.sha256.hexdigest()
        return signer.metadata(SignedStatement(gateway, epoch, number, previous_sha256, results, sound.length, sha256))

    return sign


def _append(file: BinaryIO, sound: _Sound, size: int, sign: Sign | None, unsigned: str) -> None:
    """Write the end of the file. Where the disk has no space for it, restore the file as it was and raise OSError."""
    length = sound.length
    file.seek(length)
    tail = file.read(TAIL_MAX)
    end = _end(sound, tail, size, sign, unsigned)
    try:
        file.seek(length)
        file.write(end)
        file.truncate(length + len(end))
        file.flush()
        os.fsync(file.fileno())
    except OSError:
        file.seek(length)
        file.write(tail)
        file.truncate(size)
        raise


def _end(sound: _Sound, tail: bytes, size: int, sign: Sign | None, unsigned: str) -> bytes:
    """The bytes that close the file, to be written after its intact part. `unsigned`: why it is not signed."""
    parts: list[bytes] = []

    def add(record: Any) -> None:
        builder = RecordBuilder()
        record.write(builder)
        data = builder.end()
        _take(sound.derived, FileRecord(sound.length, data[0], data[9:]))
        sound.length += len(data)
        sound.crc = zlib.crc32(data, sound.crc)
        sound.sha256.update(data)
        parts.append(data)

    kept = sound.length
    for index in sound.derived.awaited_indexes():
        add(index)
    if tail:
        add(
            Attachment(
                create_time=0, log_time=0, name=TAIL_ATTACHMENT, media_type="application/octet-stream", data=tail
            )
        )
    note = {"found_bytes": str(size), "kept_bytes": str(kept), "torn_bytes": str(size - kept)}
    add(Metadata(name=REPAIR_METADATA, metadata=note | ({UNSIGNED: unsigned} if unsigned else {})))
    if sign is not None:
        add(Metadata(name=SIGNATURE_METADATA, metadata=sign(sound)))
    return b"".join(parts) + _summary(sound)


def _summary(sound: _Sound) -> bytes:
    builder = RecordBuilder()
    DataEnd(sound.crc).write(builder)
    data_end = builder.end()
    start = sound.length + len(data_end)
    offsets = []
    for kind in KINDS[:-1]:
        group_start = builder.count
        for record in sound.derived.expected(kind, {}):
            record.write(builder)
        if builder.count > group_start:
            offsets.append(SummaryOffset(kind, start + group_start, builder.count - group_start))
    offset_start = start + builder.count
    for offset in offsets:
        offset.write(builder)
    summary: bytes = builder.end()
    Footer(start, offset_start, 0).write(builder)
    covered: bytes = builder.end()[:-4]
    crc = zlib.crc32(covered, zlib.crc32(summary))
    end: bytes = data_end + summary + covered + crc.to_bytes(4, "little") + MAGIC
    return end
