"""What the libraries `mcap`, `csv` and `pyarrow` do with the files that `agent/recording` and `agent/reading` read.

python -m benchmarks.libraries

Recordings: one of half a minute, cut at 100 places; with one of 400 bits changed; and a chunk that is 1 GB large when
it is decompressed. Tables: the heads of tests/unit/logger_heads.py that are read, each with a hundred rows; and a table
of a million rows.
"""

from __future__ import annotations

import contextlib
import csv
import io
import multiprocessing
import resource
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap.stream_reader import StreamReader

from agent.reading.delimited import Delimited
from agent.recording.integrity import check_integrity
from agent.recording.messages import is_result_topic
from agent.recording.reading import RecordingReader
from agent.recording.scan import scan
from tests.unit.logger_heads import DATED, HEADS
from tests.unit.recorded_bench import record
from tests.unit.test_logger_files import V, rows

SECONDS, CUTS, FLIPS, ROWS = 30.0, 100, 400, 1_000_000
UNPACKED = 1 << 30
FAULTS = (McapError, struct.error, ValueError, KeyError, EOFError, MemoryError, zstandard.ZstdError, OverflowError)


def by_mcap(path: Path) -> tuple[int, str]:
    """Messages that `mcap` reads in a file from its beginning, and why it ends before the footer."""
    count = 0
    with path.open("rb") as file:
        try:
            for _ in NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False):
                count += 1
        except FAULTS as error:
            return count, repr(error)
    return count, ""


def by_ours(path: Path) -> tuple[int, str]:
    """The same by agent/recording."""
    reader = RecordingReader(path)
    count = sum(1 + len(step.results) for step in reader.steps())
    return count, "" if reader.fault is None else str(reader.fault)


def found_by_mcap(path: Path) -> bool:
    """Whether `mcap` finds something wrong with the bytes of a file."""
    with path.open("rb") as file:
        try:
            for _ in StreamReader(file, validate_crcs=True).records:
                pass
        except FAULTS:
            return True
    return False


def found_by_ours(path: Path) -> bool:
    """The same by agent/recording."""
    with path.open("rb") as file:
        return check_integrity(file, path.stat().st_size).fault_count > 0


def results_by_mcap(path: Path) -> int:
    """Results that `mcap` finds by the summary."""
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        topics = [c.topic for c in summary.channels.values() if is_result_topic(c.topic)] if summary else []
        return sum(1 for _ in reader.iter_messages(topics=topics, log_time_order=False))


def bomb(path: Path, whole: bytes) -> None:
    """A file whose first chunk has UNPACKED bytes after decompression."""
    packed = zstandard.ZstdCompressor().compress(bytes(UNPACKED))
    body = struct.pack("<QQQII", 0, 1, UNPACKED, 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    head = whole[:8] + whole[8 : 8 + 9 + struct.unpack_from("<Q", whole, 9)[0]]
    path.write_bytes(head + struct.pack("<BQ", 6, len(body)) + body)


def _peak(read: Callable[[Path], object], path: Path, told: multiprocessing.SimpleQueue[float]) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with contextlib.suppress(*FAULTS):
        read(path)
    told.put((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0)


def peak_mb(read: Callable[[Path], object], path: Path) -> float:
    """Memory that a reading takes, in a process of its own."""
    fork = multiprocessing.get_context("fork")
    told: multiprocessing.SimpleQueue[float] = fork.SimpleQueue()
    process = fork.Process(target=_peak, args=(read, path, told))
    process.start()
    process.join()
    return told.get()


def taken_s(read: Callable[[Path], object], path: Path) -> float:
    """Processor time of a reading, the least of three."""
    times = []
    for _ in range(3):
        begin = time.process_time()
        read(path)
        times.append(time.process_time() - begin)
    return min(times)


def recordings(directory: Path) -> None:
    """The table of recordings."""
    record(directory / "run", SECONDS)
    path, other = directory / "run" / "fieldcal-000001.mcap", directory / "other.mcap"
    whole = path.read_bytes()
    random = np.random.default_rng(58)
    cut, flipped = np.zeros((2, CUTS), dtype=int), np.zeros(2, dtype=int)
    for k, at in enumerate(random.integers(100, len(whole) - 100, CUTS).tolist()):
        other.write_bytes(whole[:at])
        cut[:, k] = by_mcap(other)[0], by_ours(other)[0]
    for at in random.integers(0, 8 * len(whole), FLIPS).tolist():
        changed = bytearray(whole)
        changed[at // 8] ^= 1 << at % 8
        other.write_bytes(changed)
        flipped += found_by_mcap(other), found_by_ours(other)
    bomb(other, whole)
    print(f"\n| a recording of {len(whole) / 1e3:.0f} kB | mcap | agent/recording |\n| --- | --- | --- |")
    for name, one, two in (
        ("read from the beginning, ms", 1e3 * taken_s(by_mcap, path), 1e3 * taken_s(by_ours, path)),
        ("its results alone, ms", 1e3 * taken_s(results_by_mcap, path), 1e3 * taken_s(scan, path)),
        (f"messages in {CUTS} files that are cut", *cut.sum(axis=1).tolist()),
        (f"of {FLIPS} changed bits, found", *flipped.tolist()),
        ("memory for a chunk of 1 GB, MB", peak_mb(by_mcap, other), peak_mb(by_ours, other)),
    ):
        print(f"| {name} | {one:.0f} | {two:.0f} |")


def by_sniffer(path: Path) -> np.ndarray:
    """The values of a table whose dialect `csv.Sniffer` finds."""
    text = path.read_text()
    dialect = csv.Sniffer().sniff(text[: 1 << 14])
    table = [row for row in csv.reader(io.StringIO(text), dialect) if row]
    if csv.Sniffer().has_header(text[: 1 << 14]):
        table = table[1:]
    return np.array([[float(x) if x else np.nan for x in row] for row in table])


def by_pyarrow(path: Path) -> np.ndarray:
    """The values of a table as `pyarrow.csv` reads it without options."""
    from pyarrow import csv as arrow_csv

    table = arrow_csv.read_csv(path)
    return np.column_stack([np.asarray(c) for c in table.columns if str(c.type) == "double"])


def by_own(path: Path) -> np.ndarray:
    """The values of a table as agent/reading reads it."""
    source = Delimited(path)
    return np.vstack(list(source.pieces(source.columns, None)))


def has_truth(read: Callable[[Path], np.ndarray], path: Path) -> bool:
    """Whether three columns that a reading gives are those that were written."""
    try:
        values = read(path)
    except Exception:  # what is counted here
        return False
    shown = [values[:, k].astype(float) for k in range(values.shape[1])] if values.shape[:1] == (len(V),) else []
    return all(any(np.allclose(column, wanted, rtol=0, atol=1e-9) for column in shown) for wanted in V.T)


def tables(directory: Path) -> None:
    """The table of tables."""
    path, read = (
        directory / "logger.csv",
        {"csv.Sniffer": by_sniffer, "pyarrow.csv": by_pyarrow, "agent/reading": by_own},
    )
    heads = [head for head in HEADS if not head.refused]
    right = dict.fromkeys(read, 0)
    for head in heads:
        path.write_text(head.head + "".join(f"{row}\n" for row in rows(head.row, head.step_s)))
        for name, reading in read.items():
            right[name] += has_truth(reading, path)
    values = np.column_stack([DATED + 1e-3 * np.arange(ROWS), np.random.default_rng(1).normal(size=(ROWS, 3))])
    np.savetxt(path, values, "%.6f", ",", header="time_s,x,y,z", comments="")
    print(f"\n| {len(heads)} heads of loggers | {' | '.join(read)} |\n| --- | --- | --- | --- |")
    print(f"| read right without a word from the user | {' | '.join(map(str, right.values()))} |")
    print(f"| processor time for {ROWS} rows, s | {' | '.join(f'{taken_s(r, path):.2f}' for r in read.values())} |")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        recordings(Path(place))
        tables(Path(place))
