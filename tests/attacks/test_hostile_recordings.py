"""Small recordings that would take all memory or time are refused before anything large is made of them."""

from __future__ import annotations

import io
import struct
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import zstandard

from agent.core.events import RunStart
from agent.recording.files import RecordingFile
from agent.recording.integrity import check_integrity
from agent.recording.limits import UNPACKED_LIMIT, most_unpacked
from agent.recording.messages import encode, topic_of
from agent.recording.reading import RecordingReader
from agent.recording.records import MAGIC
from agent.recording.repair import close_torn
from agent.recording.scan import scan
from tests.replay.stand_in import CONFIG, StandIn, run_start

MEMORY_LIMIT = 64 << 20  # bytes, for a file of at most 1 MB
CPU_LIMIT_S = 10.0
HEADER = struct.pack("<BQII", 1, 8, 0, 0)


def peak_memory() -> int:
    """The most memory of this process since the last call, in bytes."""
    [line] = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    Path("/proc/self/clear_refs").write_text("5")
    return int(line.split()[1]) << 10


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def packed(size: int, data: bytes, crc: int) -> bytes:
    """A chunk; `data` is its content compressed, which has `size` bytes and this CRC."""
    head = struct.pack("<QQQII", 0, 0, size, crc, 4) + b"zstd" + struct.pack("<Q", len(data))
    return record(6, head + data)


def chunk_of(parts: Iterator[bytes] | list[bytes]) -> bytes:
    """A chunk of these records, made without keeping them; its sizes and its CRC are right."""
    out, size, crc = io.BytesIO(), 0, 0
    parts = list(parts)
    total = sum(len(part) for part in parts)
    with zstandard.ZstdCompressor(level=3).stream_writer(out, size=total, closefd=False) as writer:
        for part in parts:
            writer.write(part)
            size, crc = size + len(part), zlib.crc32(part, crc)
    return packed(size, out.getvalue(), crc)


def schema(number: int, length: int) -> bytes:
    body = struct.pack("<HI", number, 1) + b"x" + struct.pack("<I", 8) + b"protobuf" + struct.pack("<I", length)
    return record(3, body + bytes(length))


def messages(count: int) -> bytes:
    return (struct.pack("<BQ", 5, 22) + bytes(22)) * count


def channels(count: int) -> bytes:
    return b"".join(record(4, struct.pack("<HHII", k % 65536, 1, 0, 0) + bytes(4)) for k in range(count))


BOMBS = {
    "30 schemas of 120 MB zeros": lambda: [chunk_of([schema(1, 120_000_000)])] * 30,
    "4 million messages in a chunk": lambda: [chunk_of([messages(4_000_000)])],
    "a chunk just above the limit": lambda: [chunk_of([bytes(UNPACKED_LIMIT + 1)])],
    "270,000 messages in 8 MiB": lambda: [chunk_of([messages(UNPACKED_LIMIT // 31)])],
    "3,000 chunks of 8 MiB zeros": lambda: [chunk_of([bytes(UNPACKED_LIMIT)])] * 3000,
    "many chunks of 65,000 messages": lambda: [chunk_of([schema(1, 9), channels(1), messages(20_000)])] * 900,
    "schemas of 8 MB": lambda: [chunk_of([schema(1, 8_000_000)])] * 200,
    "a schema outside a chunk": lambda: [schema(1, 900_000)],
    "200,000 channels": lambda: [chunk_of([schema(1, 9), channels(10_000)])] * 20,
    "a frame that states no size": lambda: [packed(1 << 20, _unstated(1 << 30), 1)],
    "a frame that states less than it has": lambda: [packed(100, zstandard.compress(bytes(1 << 27)), 1)],
    "two frames": lambda: [packed(9, zstandard.compress(bytes(9)) + zstandard.compress(bytes(1 << 27)), 1)],
    "metadata of one letter, many times": lambda: [record(12, struct.pack("<I", 1) + b"n" + bytes(4))] * 5_000,
}


def _unstated(size: int) -> bytes:
    out = io.BytesIO()
    with zstandard.ZstdCompressor().stream_writer(out, closefd=False) as writer:
        for _ in range(size >> 20):
            writer.write(bytes(1 << 20))
    return out.getvalue()


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_in_bounded_memory_and_time(tmp_path: Path, name: str) -> None:
    path = tmp_path / "fieldcal-000001.mcap"
    path.write_bytes(MAGIC + HEADER + b"".join(BOMBS[name]()))
    assert path.stat().st_size < 1_000_000
    peak_memory()
    before = peak_memory()
    began_s = time.process_time()
    with open(path, "rb") as file:
        found = check_integrity(file, path.stat().st_size)
    reader = RecordingReader(path)
    steps = list(reader.steps())
    scanned = scan(path)
    active = path.rename(path.with_name(path.name + ".active"))
    close_torn(tmp_path)
    spent_s = time.process_time() - began_s
    peak = peak_memory() - before
    assert found.faults
    assert reader.fault is not None
    assert not steps
    assert not scanned.results
    assert active.exists() or not list(tmp_path.iterdir()), "nothing hostile is closed as if it were sound"
    assert peak < MEMORY_LIMIT, f"{peak / 1e6:.0f} MB"
    assert spent_s < CPU_LIMIT_S


def test_what_the_limits_are_is_told(tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    path.write_bytes(MAGIC + HEADER + chunk_of([bytes(UNPACKED_LIMIT + 1)]))
    with open(path, "rb") as file:
        fault = check_integrity(file, path.stat().st_size).faults[0]
    assert f"{UNPACKED_LIMIT + 1} bytes decompressed, more than the limit of {UNPACKED_LIMIT}" in fault.reason


def test_a_large_snapshot_and_a_dead_sensor_stay_within_the_limits(tmp_path: Path) -> None:
    """Zeros are what a dead sensor gives; they shrink to almost nothing. Our own recordings are never refused."""
    start = msgspec.structs.replace(run_start(StandIn(CONFIG), 0, 1), snapshot=bytes(UNPACKED_LIMIT + 1000))
    file = RecordingFile(tmp_path, start, ["/events"], {})
    data = encode(0, start)
    file.append(topic_of(start), data, 0, 0, 0)
    file.sync()
    path = file.path
    sent = 0
    while not file.full:
        file.append("/m/raw", bytes(1 << 20), 0, 0, 1)
        file.sync()
        sent += 1 << 20
        assert sent < most_unpacked(file.size), "the writer stops before a reader would"
    file.abandon()
    reader = RecordingReader(path)
    first = next(reader.steps())
    assert isinstance(first.event, RunStart)
    assert first.event.snapshot == start.snapshot
    with open(path, "rb") as stream:
        assert all(fault.kind == "torn" for fault in check_integrity(stream, path.stat().st_size).faults)
