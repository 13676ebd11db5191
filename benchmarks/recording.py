"""Cost of recording and replaying: CPU time per block; replay compared with decompression and CRC of the file."""

from __future__ import annotations

import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zstandard

from agent.config import Config
from agent.core.events import Event, RunStart
from agent.core.pipeline import Pipeline
from agent.recording.integrity import check_integrity
from agent.recording.reading import RecordingReader
from agent.recording.records import walk
from agent.recording.writer import Recorder
from benchmarks.page import machine, write_part
from hw.block import SampleBlock

RATE_HZ = 1000.0
BLOCK_S = 0.5
DURATION_S = 1800.0
FLUSH_S = 2.0
SECOND = 1_000_000_000


def blocks(seed: int) -> Iterator[SampleBlock]:
    """A tri-axial device with counts (ADXL355: 256000 per g, noise 100 rms) and a uniaxial one with decimals, 1 kHz."""
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


def configuration() -> Config:
    """A channel whose sensor stands for ten seconds at each of three angles, repeatedly."""
    poses = [
        {"start_s": start_s, "stop_s": start_s + 10, "theta_deg": 35, "alpha_deg": alpha_deg}
        for start_s, alpha_deg in ((3, 0), (16, 30), (29, 120))
    ]
    channel: dict[str, Any] = {"sensor": "mems", "reference": "reference", "poses": poses, "poses_repeat_s": 39}
    channel |= {"prior": {"sensitivity": 26000.0}}
    devices = [{"name": name, "driver": "adxl355"} for name in ("mems", "reference")]
    return Config.model_validate({"devices": devices, "channels": [channel]})


def record(directory: Path, events: list[Event]) -> Path:
    """Record the events and the results of the pipeline, flushed and synced like a live agent's."""
    config = configuration()
    pipeline = Pipeline.begin(config, "r", 0, 0, {})
    recorder = Recorder(directory, ["mems", "reference"], ["mems"], max_bytes=1 << 40)
    start = RunStart(
        run_id="r", site="s", gateway="g", boot_id="b", t_monotonic_ns=0, t_utc_ns=0,
        config_json=config.model_dump_json(), versions={}, fingerprint={}, snapshot=pipeline.snapshot(),
        file_sequence=1, event_sequence=0,
    )  # fmt: skip
    recorder.record(0, start, [])
    flush_each = int(2 * FLUSH_S / BLOCK_S)
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
    results = 0
    for step in RecordingReader(path).steps():
        if isinstance(step.event, RunStart):
            pipeline = Pipeline.restore(step.event.config_json, step.event.snapshot)
        assert pipeline is not None
        computed = pipeline.step(step.event)
        # As text, since a NaN does not equal itself.
        assert _text(computed) == _text(step.results)
        results += len(computed)
    assert results > DURATION_S / 39


def _text(results: Sequence[object]) -> bytes:
    return msgspec.json.encode(results, order="sorted")


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
    events: list[Event] = list(blocks(seed=1))
    with tempfile.TemporaryDirectory() as directory:
        start = time.process_time()
        path = record(Path(directory), events)
        writing_s = time.process_time() - start
        size = path.stat().st_size
        plain_s = cpu_s(decompress_and_check, path)
        rows = [(name, cpu_s(work, path)) for name, work in WORK]
    samples = sum(event.indications.size for event in events if isinstance(event, SampleBlock))
    rows = [("decompressing and CRC alone", plain_s), *rows]
    lines = [f"| {name} | {DURATION_S / s:,.0f} | {s / plain_s:.1f} |" for name, s in rows]
    writing_us = writing_s / len(events) * 1e6
    write_part(
        "recording",
        f"""
`python -m benchmarks recording` on {machine()}: half an hour of a sensor (1 kHz x 3) and a reference (1 kHz), blocks of
0.5 s, flushed and synced every {FLUSH_S:g} s. To make the results and write them takes {writing_us:.0f} us of CPU for
each block, and {size / samples:.2f} bytes for each number.

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
