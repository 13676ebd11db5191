"""What recording and reading back cost: CPU a block, and reading against plain decompressing and CRC of the same file.

Run: python -m benchmarks.recording
"""

from __future__ import annotations

import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import zstandard

from agent.events import Event, RunStart
from agent.integrity import check_integrity
from agent.mcap_records import walk
from agent.reading import RecordingReader
from agent.recording import Recorder
from hw.block import SampleBlock

RATE_HZ = 1000.0
BLOCK_S = 0.5
DURATION_S = 1800.0
FLUSH_S = 2.0
SECOND = 1_000_000_000


def blocks(seed: int) -> Iterator[SampleBlock]:
    """A tri-axial device of counts (ADXL355: 256000 a g, noise 100 rms) and a uniaxial one of decimals, 1 kHz each."""
    rng = np.random.default_rng(seed)
    n = int(RATE_HZ * BLOCK_S)
    for number in range(int(DURATION_S / BLOCK_S)):
        time_s = (number * n + np.arange(n)) / RATE_HZ
        motion_mps2 = np.sin(2 * np.pi * 2.0 * time_s)
        counts = np.rint(rng.normal(0.0, 100.0, (n, 3)) + 26000.0 * np.outer(motion_mps2, [0.1, 0.05, 1.0]))
        arrivals_ns = ((number * n + np.arange(32, n + 32, 32)) * 1e9 / RATE_HZ).astype(np.int64)
        bursts = np.minimum(np.arange(32, n + 32, 32), n).astype(np.int32)
        for device, indications in (("mems", counts.astype(np.int32)), ("reference", motion_mps2[:, None].round(4))):
            yield SampleBlock(
                device, "boot", int(arrivals_ns[-1]), number * n, RATE_HZ, arrivals_ns, bursts, indications
            )


def record(directory: Path, events: list[Event]) -> Path:
    """Record the events, flushed and synced as a live agent does."""
    recorder = Recorder(directory, ["mems", "reference"], ["mems"], max_bytes=1 << 40)
    recorder.record(0, run_start(), [])
    flush_each = int(2 * FLUSH_S / BLOCK_S)
    for number, event in enumerate(events, start=1):
        recorder.record(number, event, [])
        if number % flush_each == 0:
            recorder.sync()
    recorder.close()
    return directory / "fieldcal-000001.mcap"


def run_start() -> RunStart:
    """A RunStart with nothing in it."""
    return RunStart(
        run_id="r",
        site="s",
        gateway="g",
        boot_id="b",
        t_monotonic_ns=0,
        t_utc_ns=0,
        config_json="{}",
        versions={},
        fingerprint={},
        snapshot=b"",
        file_sequence=1,
        event_sequence=0,
    )


def decompress_and_check(path: Path) -> None:
    """The least that any reader must do: every chunk unpacked, its CRC computed."""
    with open(path, "rb") as file:
        for record in walk(file, path.stat().st_size):
            if record.name == "Chunk":
                zlib.crc32(zstandard.ZstdDecompressor().decompress(record.body[44:]))


def read(path: Path) -> None:
    """All events, as replay gets them."""
    for _ in RecordingReader(path).steps():
        pass


def check(path: Path) -> None:
    """The audit's pass over the bytes."""
    with open(path, "rb") as file:
        assert not check_integrity(file, path.stat().st_size).faults


def cpu_s(work: Callable[[Path], object], path: Path) -> float:
    """Least CPU time of three runs, in s."""
    times = []
    for _ in range(3):
        start = time.process_time()
        work(path)
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    """Measure and print."""
    events: list[Event] = list(blocks(seed=1))
    with tempfile.TemporaryDirectory() as directory:
        start = time.process_time()
        path = record(Path(directory), events)
        writing_s = time.process_time() - start
        size = path.stat().st_size
        plain_s, reading_s, checking_s = (cpu_s(work, path) for work in (decompress_and_check, read, check))
    samples = sum(event.indications.size for event in events if isinstance(event, SampleBlock))
    print(f"written: {writing_s / len(events) * 1e6:.0f} us a block of 0.5 s, {size / samples:.2f} bytes a number")
    for name, seconds in (("plain", plain_s), ("reading", reading_s), ("integrity", checking_s)):
        print(f"{name}: {DURATION_S / seconds:.0f} times real time, {seconds / plain_s:.2f} of plain")


if __name__ == "__main__":
    main()
