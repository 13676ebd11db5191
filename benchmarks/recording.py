"""Cost of recording and replaying: CPU time per block; replay compared with decompression and CRC of the file."""

from __future__ import annotations

import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import zstandard

from agent.config import Config
from agent.core.events import Event, RunStart, WindowReport
from agent.core.pipeline import Pipeline
from agent.engine import identity
from agent.recording.integrity import check_integrity
from agent.recording.reading import RecordingReader
from agent.recording.records import walk
from agent.recording.writer import Recorder
from benchmarks.online import day
from benchmarks.online.runner import EPOCH_NS
from benchmarks.page import machine, write_part
from hw.block import SampleBlock

BLOCK_S = 0.5
DURATION_S = 1800.0
FLUSH_S = 2.0


def record(directory: Path, config: Config, events: list[Event]) -> Path:
    """Record the events and the results of the pipeline, flushed and synced like a live agent's."""
    pipeline = Pipeline.begin(config, "r", 0, EPOCH_NS, {})
    recorder = Recorder(directory, ["sensor", "reference"], ["sensor"], max_bytes=1 << 40)
    start = RunStart(
        run_id="r", site="s", gateway="g", boot_id="b", t_monotonic_ns=0, t_utc_ns=EPOCH_NS,
        config_json=config.model_dump_json(), versions={}, fingerprint={}, snapshot=pipeline.snapshot(),
        file_sequence=1, event_sequence=0, engine=identity.name(),
    )  # fmt: skip
    recorder.record(0, start, pipeline.step(start))
    flush_each = int(3 * FLUSH_S / BLOCK_S)  # two blocks and a tick
    for number, event in enumerate(events, start=1):
        recorder.record(number, event, pipeline.step(event))
        if number % flush_each == 0:
            recorder.sync()
    recorder.close()
    return directory / "fieldcal-000001.mcap"


def decompress_and_check(path: Path) -> None:
    """The minimum work of any reader: decompress every chunk and compute its CRC."""
    with open(path, "rb") as file:
        for record in walk(file, path.stat().st_size):
            if record.name == "Chunk":
                zlib.crc32(zstandard.ZstdDecompressor().decompress(record.body[44:]))


def read(path: Path) -> None:
    """Read all events like replay does."""
    for _ in RecordingReader(path).steps():
        pass


def replay(path: Path) -> None:
    """All events through the pipeline: `fieldcal replay` without its start."""
    pipeline: Pipeline | None = None
    windows = 0
    for step in RecordingReader(path).steps():
        if isinstance(step.event, RunStart):
            pipeline = Pipeline.restore(step.event.config_json, step.event.snapshot)
        assert pipeline is not None
        computed = pipeline.step(step.event)
        assert _plain(computed) == _plain(step.results)
        windows += sum(isinstance(result, WindowReport) and result.used for result in computed)
    assert windows > DURATION_S / 60 - 2


def _plain(results: Sequence[object]) -> Any:
    """Without NaN, which does not equal itself."""
    return msgspec.json.decode(msgspec.json.encode(results))


def check(path: Path) -> None:
    """The audit's check of all bytes."""
    with open(path, "rb") as file:
        assert not check_integrity(file, path.stat().st_size).faults


def cpu_s(work: Callable[[Path], object], path: Path) -> float:
    """Smallest CPU time of three runs, s."""
    times = []
    for _ in range(3):
        start = time.process_time()
        work(path)
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    """Measure and write the table."""
    bench = day.bench()
    events = list(day.events(bench, DURATION_S, BLOCK_S))
    with tempfile.TemporaryDirectory() as directory:
        start = time.process_time()
        path = record(Path(directory), day.config(bench), events)
        writing_s = time.process_time() - start
        size = path.stat().st_size
        plain_s = cpu_s(decompress_and_check, path)
        rows = [(name, cpu_s(work, path)) for name, work in WORK]
    blocks = [event for event in events if isinstance(event, SampleBlock)]
    samples = sum(block.indications.size for block in blocks)
    rows = [("decompressing and CRC alone", plain_s), *rows]
    lines = [f"| {name} | {DURATION_S / s:,.0f} | {s / plain_s:.1f} |" for name, s in rows]
    writing_us = writing_s / len(blocks) * 1e6
    write_part(
        "recording",
        f"""
`python -m benchmarks recording` on {machine()}: half an hour of the bench of `benchmarks.online day`,
a window a minute: a sensor (1 kHz x 3) and a reference (1 kHz), blocks of 0.5 s, flushed and synced each {FLUSH_S:g} s.
To make the results and write them takes {writing_us:.0f} us of CPU for each block, and {size / samples:.2f} bytes for
each number.

| work | speed, in multiples of real time | CPU time, divided by that of decompressing and CRC alone |
| --- | --- | --- |
"""
        + "\n".join(lines),
    )


WORK = (
    ("reading: all events and results checked and decoded", read),
    ("replay: reading, the pipeline, results compared", replay),
    ("integrity: the audit's pass over every byte", check),
)

if __name__ == "__main__":
    main()
