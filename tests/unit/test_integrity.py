"""Every changed byte of a recording is found, and its place told; hostile files cost neither memory nor a traceback."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import IndexType, Writer

from agent.recording.crc_location import changed_byte
from agent.recording.integrity import Integrity, check_integrity
from agent.recording.limits import RECORD_LIMIT
from agent.recording.messages import encode, schema_data, topic_of
from agent.recording.reading import RecordingReader
from agent.recording.records import MAGIC, FileRecordError
from tests.replay.forgery import records, with_sums, write_messages
from tests.replay.stand_in import CONFIG, StandIn, happenings, record_run, run_start

MEMORY_LIMIT = 3 * RECORD_LIMIT  # bytes; a record, its content, and the parts it is taken into


def check(data: bytes) -> Integrity:
    return check_integrity(io.BytesIO(data), len(data))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A small whole recording."""
    directory = tmp_path_factory.mktemp("recording")
    record_run(directory, blocks=3)
    return (directory / "fieldcal-000001.mcap").read_bytes()


def test_a_whole_recording_has_no_fault(recording: bytes) -> None:
    found = check(recording)
    assert found.faults == []
    assert found.finished
    assert found.good_bytes == len(recording)
    assert found.messages > 8


def place(data: bytes, offset: int) -> tuple[int, int]:
    """Begin and end of the record (or magic) that a byte belongs to."""
    if offset < len(MAGIC):
        return 0, len(MAGIC)
    return next(
        ((r.offset, r.end) for r in records(data) if r.offset <= offset < r.end), (len(data) - len(MAGIC), len(data))
    )


def assert_found(data: bytes, offset: int, flip: int, span: tuple[int, int]) -> None:
    changed = bytearray(data)
    changed[offset] ^= flip
    found = check(bytes(changed))
    assert found.faults, f"byte {offset} ^ {flip:#x} was not noticed"
    first = found.faults[0]
    assert span[0] <= first.offset < span[1], f"byte {offset} ^ {flip:#x} was placed at {first}"


@pytest.mark.slow
@pytest.mark.parametrize("step", [17, pytest.param(3, marks=pytest.mark.nightly)])
def test_every_changed_byte_is_found_in_its_record(recording: bytes, step: int) -> None:
    """Those near the begin of a record, which tells its kind and length, or its end; each `step`-th of the others."""
    flips = np.random.default_rng(1).integers(1, 256, len(recording))
    borders = {at + k for record in records(recording) for at in (record.offset, record.end) for k in range(-4, 9)}
    spans = {r.offset: (r.offset, r.end) for r in records(recording)}
    spans |= {0: (0, len(MAGIC)), len(recording) - len(MAGIC): (len(recording) - len(MAGIC), len(recording))}
    span = spans[0]
    for offset, flip in enumerate(flips):
        span = spans.get(offset, span)
        if offset % step and offset not in borders:
            continue
        assert_found(recording, offset, int(flip), span)


@pytest.mark.slow
def test_every_changed_bit_of_a_sample_is_found(recording: bytes) -> None:
    sample = np.random.default_rng(2).choice(len(recording), 75, replace=False)
    for offset in sample.tolist():
        span = place(recording, offset)
        for bit in range(8):
            assert_found(recording, offset, 1 << bit, span)


@pytest.mark.slow
def test_every_cut_is_incomplete_with_the_last_good_byte(recording: bytes) -> None:
    ends = [len(MAGIC), *(record.end for record in records(recording))]
    for size in range(0, len(recording), 7):
        found = check(recording[:size])
        assert not found.finished
        assert [fault.kind for fault in found.faults if fault.kind == "torn"] or size > ends[-2]
        assert found.good_bytes == max((end for end in ends if len(MAGIC) < end <= size), default=0)


def test_bytes_after_the_end_are_found(recording: bytes) -> None:
    assert check(recording + b"\0").faults[0].offset == len(recording)


@pytest.mark.parametrize("opcode", [0x03, 0x04, 0x08, 0x0B, 0x0D, 0x0E])
def test_a_summary_that_contradicts_the_data_is_found_though_the_sums_fit(recording: bytes, opcode: int) -> None:
    start = next(record.end for record in records(recording) if record.opcode == 0x0F)
    assert with_sums(recording) == recording
    for record in records(recording):
        if record.opcode == opcode and record.offset >= start:
            changed = bytearray(recording)
            changed[record.offset + 9] ^= 1
            found = check(with_sums(bytes(changed)))
            assert found.faults
            assert "agree" in found.faults[0].reason


def test_a_chunk_that_lies_about_its_times_is_found_though_the_sums_fit(recording: bytes) -> None:
    chunk_record = next(record for record in records(recording) if record.name == "Chunk")
    changed = bytearray(recording)
    changed[chunk_record.offset + 9] ^= 1
    found = check(with_sums(bytes(changed)))
    assert (found.faults[0].offset, found.faults[0].record) == (chunk_record.offset, "Chunk")
    assert "times" in found.faults[0].reason


def test_message_indexes_are_held_against_the_chunk(recording: bytes) -> None:
    index = next(record for record in records(recording) if record.opcode == 0x07)
    changed = bytearray(recording)
    changed[index.end - 1] ^= 1
    found = check(with_sums(bytes(changed)))
    assert (found.faults[0].offset, found.faults[0].record) == (index.offset, "MessageIndex")
    without = check(recording[: index.offset] + recording[index.end :])
    assert "message index of channels [1]" in without.faults[0].reason


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"enable_data_crcs": False}, "is missing in it"),
        ({"enable_crcs": False}, "CRC does not fit"),
        ({"index_types": IndexType.NONE}, "comes before the message index"),
        ({"index_types": IndexType.MESSAGE}, "the summary has 0 of ChunkIndex, but the data section needs 1"),
        ({"use_statistics": False}, "the summary has 0 of Statistics, but the data section needs 1"),
        ({"repeat_channels": False}, "the summary has 0 of Channel, but the data section needs 1"),
        ({"use_summary_offsets": False}, "offsets must be before it"),
        ({"use_chunking": False}, "does not belong here"),
    ],
)
def test_files_written_with_less_are_refused(options: dict[str, Any], reason: str) -> None:
    out = io.BytesIO()
    writer = Writer(out, **({"enable_data_crcs": True} | options))
    writer.start()
    schema = writer.register_schema("fieldcal.v1.Event", "protobuf", schema_data("fieldcal.v1.Event"))
    writer.add_message(writer.register_channel("/events", "protobuf", schema), 0, b"", 0)
    writer.finish()
    assert any(reason in fault.reason for fault in check(out.getvalue()).faults)


@pytest.mark.slow
@given(data=st.binary(min_size=1, max_size=300), at=st.integers(0, 299), flip=st.integers(1, 255))
def test_the_crc_tells_which_byte_changed(data: bytes, at: int, flip: int) -> None:
    at %= len(data)
    changed = bytearray(data)
    changed[at] ^= flip
    assert changed_byte(zlib.crc32(data), zlib.crc32(changed), len(data)) == at


def test_a_crc_that_no_single_byte_explains_names_none() -> None:
    data = bytes(1000)
    changed = bytearray(data)
    changed[10] = changed[900] = 1
    assert changed_byte(zlib.crc32(data), zlib.crc32(changed), len(data)) is None


def chunk(
    announced: int, packed: bytes, compression: bytes = b"zstd", data_length: int | None = None, crc: int = 1
) -> bytes:
    length = len(packed) if data_length is None else data_length
    head = struct.pack("<QQQII", 0, 0, announced, crc, len(compression)) + compression + struct.pack("<Q", length)
    return struct.pack("<BQ", 6, len(head + packed)) + head + packed


HEADER = struct.pack("<BQII", 1, 8, 0, 0)
HUGE_FRAME = zstandard.compress(b"x")[:4] + b"\xe0" + struct.pack("<Q", 1 << 40) + b"\x01\x00\x00"


@pytest.mark.parametrize(
    "hostile",
    [
        struct.pack("<BQ", 6, 1 << 63),
        struct.pack("<BQ", 6, (1 << 64) - 1),
        struct.pack("<BQ", 12, 1 << 31) + b"x" * 100,
        chunk(1 << 62, b"\0" * 50),
        chunk(1 << 40, HUGE_FRAME),
        chunk(100, HUGE_FRAME),
        chunk(1 << 24, zstandard.compress(bytes((1 << 24) - 1))),
        chunk(RECORD_LIMIT + 1, zstandard.compress(bytes(RECORD_LIMIT + 1))),
        chunk(5, b"\0" * 5, compression=b"lz4"),
        chunk(5, b"\0" * 5, data_length=1 << 63),
        struct.pack("<BQI", 12, 4, (1 << 32) - 1),
        struct.pack("<BQIII", 12, 12, 0, (1 << 32) - 1, 0),
        struct.pack("<BQQQIIQ", 9, 32, 0, 0, 0, 0, 1 << 63),
        struct.pack("<BQHI", 7, 6, 0, (1 << 32) - 16),
        struct.pack("<BQ", 0x80, 0),
        struct.pack("<BQ", 0, 5) + b"12345",
        struct.pack("<BQ", 5, 22) + bytes(22),
    ],
)
def test_hostile_lengths_are_refused_in_bounded_memory(hostile: bytes, tmp_path: Path) -> None:
    data = MAGIC + HEADER + hostile + MAGIC
    (tmp_path / "hostile.mcap").write_bytes(data)
    tracemalloc.start()
    found = check(data)
    reader = RecordingReader(tmp_path / "hostile.mcap")
    assert list(reader.steps()) == []
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found.faults[0].offset == len(MAGIC + HEADER)
    assert reader.fault is not None
    assert peak < MEMORY_LIMIT


def test_a_record_beyond_the_limit_is_not_read() -> None:
    data = MAGIC + HEADER + struct.pack("<BQ", 12, RECORD_LIMIT + 1)
    found = check_integrity(io.BytesIO(data), 1 << 40)
    assert f"more than the limit of {RECORD_LIMIT}" in found.faults[0].reason


@pytest.mark.parametrize("opcode", [3, 4, 5])
def test_a_record_inside_a_chunk_cannot_reach_beyond_it(opcode: int) -> None:
    inside = struct.pack("<BQ", opcode, 1 << 62) + bytes(30)
    packed = chunk(len(inside), inside, compression=b"", crc=zlib.crc32(inside))
    found = check(MAGIC + HEADER + packed + MAGIC)
    assert "reaches beyond the chunk's end" in found.faults[0].reason


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """A file spoilt in one to four places: bytes set, cut out, doubled, lengths made large, or the end cut off."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at, n = int(rng.integers(len(out))), int(rng.integers(1, 40))
        kind = rng.integers(5)
        if kind == 0:
            out[at : at + n] = rng.bytes(n)
        elif kind == 1:
            del out[at : at + n]
        elif kind == 2:
            out[at:at] = out[at : at + n]
        elif kind == 3:
            out[at : at + 8] = struct.pack("<Q", int(rng.integers(1 << 63)) >> int(rng.integers(64)))
        elif len(out) > 200:
            del out[-n:]
    return bytes(out)


@pytest.mark.slow
def test_mutated_files_are_refused_cleanly(recording: bytes, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    path = tmp_path / "mutated.mcap"
    for case in range(500):
        data = mutated(recording, rng)
        path.write_bytes(data)
        reader = RecordingReader(path)
        steps = list(reader.steps())
        assert data == recording or check(data).faults, f"case {case} was not noticed"
        assert reader.good_bytes <= len(data)
        assert all(step.event_sequence == number for number, step in enumerate(steps))


@pytest.mark.slow
def test_mutated_messages_in_sound_files_are_refused_cleanly(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    events = [run_start(StandIn(CONFIG), 0, 1), *happenings(5, seed=1)]
    path = tmp_path / "mutated.mcap"
    refused = 0
    for _ in range(200):
        spoilt = int(rng.integers(len(events)))
        messages = [(topic_of(event), number, encode(number, event)) for number, event in enumerate(events)]
        topic, _, data = messages[spoilt]
        messages[spoilt] = (topic, spoilt, mutated(data, rng))
        write_messages(path, messages)
        reader = RecordingReader(path)
        steps = list(reader.steps())
        refused += reader.fault is not None
        assert len(steps) >= (spoilt if reader.fault else len(events))
    assert refused > 100  # the others differ in values only, which no format can tell


def test_a_walk_ends_with_the_fault() -> None:
    with pytest.raises(FileRecordError, match="does not begin with the bytes of an MCAP file"):
        records(b"not an mcap file")
