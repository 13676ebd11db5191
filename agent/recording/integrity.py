"""Check that each byte of a recording is as its writer wrote it.

Checked are the magic bytes, the record boundaries, every CRC, and that the summary agrees with the data section. The
content of the messages is not checked.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Any, BinaryIO, cast

from mcap.opcode import Opcode
from mcap.records import Attachment, DataEnd, Footer, MessageIndex, Metadata

from agent.recording.crc_location import changed_byte
from agent.recording.records import MAGIC, FileFault, FileRecord, FileRecordError, parse, record_name, refusal, walk
from agent.recording.results_chain import EPOCH, FILE_METADATA, ResultsChain
from agent.recording.signing import SignedStatement
from agent.recording.summary import KINDS, DerivedSummary

FAULTS_KEPT = 20  # faults kept for one file; the others are only counted


@dataclass(slots=True)
class Integrity:
    """What the check found. `good_bytes`: offset of the end of the last record with valid boundaries."""

    faults: list[FileFault] = field(default_factory=list)
    fault_count: int = 0
    finished: bool = False
    good_bytes: int = 0
    chunks: int = 0
    messages: int = 0
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # by name; of one name, the last record
    results: ResultsChain = field(default_factory=ResultsChain)  # at the end of the file

    def statement(self, gateway: str, file_sequence: int) -> SignedStatement:
        """What the signature of this file must say; its content is hashed when the signature is checked."""
        origin = self.metadata.get(FILE_METADATA, {})
        epoch, previous_sha256 = origin.get(EPOCH, ""), origin.get("previous_sha256", "")
        return SignedStatement(gateway, epoch, file_sequence, previous_sha256, self.results.text, 0, "")

    def add(self, fault: FileFault) -> None:
        """Count a fault; keep it if it is among the first."""
        self.fault_count += 1
        if len(self.faults) < FAULTS_KEPT:
            self.faults.append(fault)


def check_integrity(file: BinaryIO, size: int) -> Integrity:
    """Check an open MCAP file of `size` bytes, which is read from its beginning. Raises OSError."""
    found = Integrity()
    check = _Check(found)
    try:
        for record in walk(file, size):
            check.take(record)
            found.good_bytes = record.end
        found.finished = True
        found.good_bytes = size
    except FileRecordError as error:
        found.add(error.fault)
    found.results = check.results
    for broken in check.broken_sums:
        found.add(broken.fault if found.faults else _located(file, size, broken))
    return found


@dataclass(frozen=True, slots=True)
class _BrokenSum:
    """A recorded CRC of bytes `start` to `end` that differs from the computed one."""

    start: int
    end: int
    recorded: int
    computed: int
    fault: FileFault


def _located(file: BinaryIO, size: int, broken: _BrokenSum) -> FileFault:
    """The fault at the single changed byte that explains a wrong CRC; where there is no such byte, the CRC's fault."""
    at = changed_byte(broken.recorded, broken.computed, broken.end - broken.start)
    if at is None:
        return broken.fault
    at += broken.start
    file.seek(0)
    kind = next((record.name for record in walk(file, size) if record.offset <= at < record.end), "magic")
    reason = f"this one byte changed, as the CRC of bytes {broken.start} to {broken.end} shows"
    return FileFault("corrupt", at, kind, reason)


class _Check:
    """The state of one pass over the records."""

    def __init__(self, found: Integrity) -> None:
        self._found = found
        self._crc = zlib.crc32(MAGIC)
        self._take = self._header
        self._summary_start = 0
        self._derived = DerivedSummary()
        self._groups: dict[int, list[tuple[FileRecord, Any]]] = {}
        self.broken_sums: list[_BrokenSum] = []

    @property
    def results(self) -> ResultsChain:
        """The chain of the results so far."""
        return self._derived.results

    def take(self, record: FileRecord) -> None:
        """Check the next record of the file; add what is wrong to the faults."""
        before = self._crc
        self._crc = zlib.crc32(record.body, zlib.crc32(record.head, before))
        try:
            if record.opcode == Opcode.FOOTER:
                self._footer(record, before)
            elif record.opcode == Opcode.DATA_END and not self._summary_start:
                self._data_end(record, before)
            else:
                self._take(record)
        except FileRecordError as error:
            self._found.add(error.fault)

    def _header(self, record: FileRecord) -> None:
        self._take = self._data
        if record.opcode != Opcode.HEADER:
            raise refusal(record, "the first record must be a Header")
        parse(record)

    def _data(self, record: FileRecord) -> None:
        if record.opcode == Opcode.MESSAGE_INDEX:
            return self._derived.add_message_index(record, cast(MessageIndex, parse(record)))
        self._derived.end_of_indexes(record)
        if record.opcode == Opcode.CHUNK:
            self._derived.add_chunk(record)
            self._found.chunks, self._found.messages = len(self._derived.chunks), self._derived.messages
            return None
        parsed = parse(record)
        if isinstance(parsed, Metadata):
            self._found.metadata[parsed.name] = parsed.metadata
            return self._derived.add_metadata(record, parsed)
        if isinstance(parsed, Attachment):
            return self._derived.add_attachment(record, parsed)
        raise refusal(record, "does not belong here, in the data section")

    def _data_end(self, record: FileRecord, crc: int) -> None:
        self._take = self._summary
        self._crc = 0
        self._summary_start = record.end
        self._derived.end_of_indexes(record)
        recorded = cast(DataEnd, parse(record)).data_section_crc
        self._compare_sums(0, record.offset, recorded, crc, record)

    def _compare_sums(self, start: int, end: int, recorded: int, computed: int, record: FileRecord) -> None:
        if recorded == 0:
            raise refusal(record, f"the CRC of bytes {start} to {end} is missing in it")
        if recorded != computed:
            reason = f"the CRC in it does not fit bytes {start} to {end}: at least one byte changed"
            fault = FileFault("corrupt", record.offset, record.name, reason)
            self.broken_sums.append(_BrokenSum(start, end, recorded, computed, fault))

    def _summary(self, record: FileRecord) -> None:
        if record.opcode not in KINDS:
            raise refusal(record, "does not belong here, in the summary")
        group = self._groups.setdefault(record.opcode, [])
        group.append((record, parse(record)))
        if len(group) > 1 and group[-2][0].end != record.offset:
            raise refusal(record, "stands apart from the other summary records of its kind")

    def _footer(self, record: FileRecord, crc: int) -> None:
        if not self._summary_start:
            raise refusal(record, "there is no record DataEnd before it")
        footer = cast(Footer, parse(record))
        covered = record.head + record.body[:16]
        end = record.offset + len(covered)
        self._compare_sums(self._summary_start, end, footer.summary_crc, zlib.crc32(covered, crc), record)
        if self._found.faults or self.broken_sums:
            return  # where the data are damaged, the correct summary is not known
        offsets = self._groups.get(Opcode.SUMMARY_OFFSET)
        if not offsets or footer.summary_start != self._summary_start:
            reason = f"it must name byte {self._summary_start}, where the summary begins, and offsets must be before it"
            raise refusal(record, reason)
        if footer.summary_offset_start != offsets[0][0].offset or offsets[-1][0].end != record.offset:
            first = offsets[0][0].offset
            raise refusal(record, f"it must name byte {first}, where the summary's offsets begin, and follow them")
        for kind in KINDS:
            self._compare_group(record, kind)

    def _compare_group(self, footer: FileRecord, kind: Opcode) -> None:
        """Compare the summary's records of one kind with the ones derived from the data section."""
        present, expected = self._groups.get(kind, []), self._derived.expected(kind, self._groups)
        for (record, parsed), wanted in zip(present, expected, strict=False):
            if parsed != wanted:
                raise refusal(record, "does not agree with the data section")
        if len(present) != len(expected):
            at = present[-1][0] if present else footer
            kind_name = record_name(kind)
            reason = f"the summary has {len(present)} of {kind_name}, but the data section needs {len(expected)}"
            raise refusal(at, reason)
