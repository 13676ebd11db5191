"""Recordings: bytes a number, part by part, and CPU time of writing, reading and replay, with packed and plain blocks.

`python -m benchmarks recording` measures half an hour of `benchmarks.online day` and writes the page.
`python -m benchmarks.recording FILE...` prints the bytes of recordings, as they are and with plain blocks.
Plain blocks are those of versions before the packed ones: an array of 32 bits a count or 64 bits a decimal.
"""

from __future__ import annotations

import io
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zstandard

from agent.config import Config
from agent.core.events import Event, RunStart, WindowReport
from agent.core.pipeline import Pipeline
from agent.engine import identity
from agent.proto import fieldcal_pb2 as pb
from agent.recording.files import RecordingFile
from agent.recording.integrity import check_integrity
from agent.recording.limits import UsedLimits
from agent.recording.messages import decode, schema_of
from agent.recording.raw_block import encode_block
from agent.recording.reading import RecordingReader
from agent.recording.records import ChunkMessage, content, unpack, walk
from agent.recording.writer import Recorder
from benchmarks.online import day
from benchmarks.online.runner import EPOCH_NS
from benchmarks.page import machine, write_part
from hw.block import SampleBlock

BLOCK_S = 0.5
DURATION_S = 1800.0
FLUSH_S = 2.0
ROUNDS = 5
Encode = Callable[[int, SampleBlock], bytes]
Item = tuple[str, ChunkMessage, SampleBlock | None]  # topic, message, and the block where it is one


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


def as_sent(event: Event) -> Event:
    """The event; decimals with the five digits that the virtual serial device writes."""
    if isinstance(event, SampleBlock) and event.indications.dtype == np.float64:
        return replace(event, indications=np.rint(event.indications * 1e5) / 1e5)
    return event


def plain_block(event_sequence: int, block: SampleBlock) -> bytes:
    """A block as versions before the packed blocks encoded it."""
    decimal = block.indications.dtype == np.float64
    names = ("x", "y", "z") if decimal else ("x_counts", "y_counts", "z_counts")
    columns = np.ascontiguousarray(block.indications.T)
    message = pb.RawBlockBytes(
        event_sequence=event_sequence, device=block.device, boot_id=block.boot_id, t_utc_ns=block.t_utc_ns,
        first_index=block.first_index, nominal_rate_hz=block.nominal_rate_hz, flags=int(block.flags),
        temperature_raw=block.temperature_raw, temperature_degc=block.temperature_degc, axes=len(columns),
        decimal=decimal, burst_t_monotonic_ns=block.burst_t_monotonic_ns.tobytes(),
        burst_count=block.burst_count.tobytes(),
    )  # fmt: skip
    for name, column in zip(names, columns, strict=False):
        setattr(message, name, column.tobytes())
    return message.SerializeToString(deterministic=True)


def chunks(path: Path) -> list[list[Item]]:
    """All messages of a recording, chunk by chunk."""
    found: list[list[Item]] = []
    topics: dict[int, str] = {}
    with open(path, "rb") as file:
        for record in walk(file, path.stat().st_size):
            if record.name == "Chunk":
                found.append([])
                for part in content(record, unpack(record, UsedLimits()), UsedLimits()):
                    if isinstance(part, ChunkMessage):
                        topic = topics[part.channel_id]
                        _, item = decode(schema_of(topic), part.data)
                        found[-1].append((topic, part, item if isinstance(item, SampleBlock) else None))
                    elif hasattr(part, "topic"):
                        topics[part.id] = part.topic
    return found


def write(found: Sequence[Sequence[Item]], encode: Encode, directory: Path) -> Path:
    """Write a recording of these messages, with the same chunks, as the agent does; blocks are encoded by `encode`."""
    _, start = decode(schema_of("/events"), found[0][0][1].data)
    assert isinstance(start, RunStart)
    file = RecordingFile(directory, start, [], {})
    for chunk in found:
        for topic, message, block in chunk:
            data = message.data if block is None else encode(message.sequence, block)
            file.append(topic, data, message.log_time, message.publish_time, message.sequence)
        file.sync()
    file.finish()
    return file.final_path


def parts(path: Path) -> dict[str, int]:
    """Bytes of each part of a recording. What is in chunks is told as it is before compression, in brackets."""
    outside: Counter[str] = Counter()
    inside: Counter[str] = Counter()
    with open(path, "rb") as file:
        for record in walk(file, path.stat().st_size):
            size = record.end - record.offset
            if record.name == "Chunk":
                chunk = unpack(record, UsedLimits())
                outside["compressed content of chunks"] += chunk.compressed_size
                outside["heads of chunks"] += size - chunk.compressed_size
            elif record.name == "MessageIndex":
                outside["message indexes"] += size
            else:
                outside["all else: summary, metadata"] += size
    for chunk_messages in chunks(path):
        for topic, message, _ in chunk_messages:
            kind = "raw blocks" if topic.endswith("/raw") else "events" if topic == "/events" else "results"
            inside[f"({kind})"] += len(message.data)
            inside["(heads of messages)"] += 31
    outside["magic"] = 16
    return {**outside, **inside}


def numbers(found: Sequence[Sequence[Item]]) -> int:
    """Numbers of all blocks: samples times axes."""
    return sum(block.indications.size for chunk in found for _, _, block in chunk if block is not None)


def steim2_bytes(found: Sequence[Sequence[Item]]) -> int:
    """Bytes of the same samples as MiniSEED (Steim2), without arrivals; decimals as the whole numbers of the blocks."""
    from obspy import Stream, Trace

    columns: dict[tuple[str, int], list[Any]] = {}
    for chunk in found:
        for _, _, block in chunk:
            if block is not None:
                message = pb.RawBlockBytes.FromString(encode_block(0, block))
                whole = np.rint(block.indications * 10.0**message.decimal_places).astype(np.int32)
                for axis, column in enumerate(whole.T):
                    columns.setdefault((block.device, axis), []).append(column)
    file = io.BytesIO()
    traces = [Trace(np.concatenate(column)) for column in columns.values()]
    Stream(traces).write(file, format="MSEED", encoding="STEIM2")
    return len(file.getvalue())


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


def write_anew(found: Sequence[Sequence[Item]], encode: Encode) -> None:
    """Write the recording into a directory that is deleted."""
    with tempfile.TemporaryDirectory() as directory:
        write(found, encode, Path(directory))


def pair_s(plain: Callable[[], object], packed: Callable[[], object]) -> tuple[float, float]:
    """Smallest CPU time of each in s; the two take turns, so that what else the machine does disturbs both."""
    least = [float("inf")] * 2
    for _ in range(ROUNDS):
        for place, work in enumerate((plain, packed)):
            start = time.process_time()
            work()
            least[place] = min(least[place], time.process_time() - start)
    return least[0], least[1]


def bytes_table(found: Sequence[Sequence[Item]], plain: Path, packed: Path) -> str:
    """Bytes a number of each part of a recording, with plain blocks and with packed ones."""
    n, sizes = numbers(found), [parts(path) for path in (plain, packed)]
    sizes = [{"the whole file": path.stat().st_size, **size} for path, size in zip((plain, packed), sizes, strict=True)]
    lines = [f"| {part} | {size / n:.3f} | {sizes[1][part] / n:.3f} |" for part, size in sizes[0].items()]
    lines.append(f"| MiniSEED, Steim2, of the same samples without arrivals | | {steim2_bytes(found) / n:.3f} |")
    return "\n".join(["| bytes a number | plain blocks | packed blocks |", "| --- | --- | --- |", *lines])


def main() -> None:
    """Measure and write the tables."""
    bench = day.bench()
    with tempfile.TemporaryDirectory() as directory:
        events = [as_sent(event) for event in day.events(bench, DURATION_S, BLOCK_S)]
        path = record(Path(directory), day.config(bench), events)
        found = chunks(path)
        plain, packed = both(found, Path(directory))
        written = pair_s(partial(write_anew, found, plain_block), partial(write_anew, found, encode_block))
        pairs = [("writing: blocks encoded, compressed, hashed, synced", written)]
        for name, work in WORK:
            pairs.append((name, pair_s(partial(work, plain), partial(work, packed))))
        sizes = bytes_table(found, plain, packed)
    blocks = sum(block is not None for chunk in found for _, _, block in chunk)
    lines = [
        f"| {name} | {a / blocks * 1e6:.0f} | {b / blocks * 1e6:.0f} | {b / a - 1:+.0%} |" for name, (a, b) in pairs
    ]
    write_part(
        "recording",
        f"""
`python -m benchmarks recording` on {machine()}: half an hour of the bench of `benchmarks.online day`,
a window a minute: a sensor (1 kHz x 3) and a reference (1 kHz), blocks of 0.5 s, flushed and synced each {FLUSH_S:g} s.
Plain blocks are those of versions before the packed ones, written in the same run.

{sizes}

CPU time, us a block, the smallest of {ROUNDS} turns:

| work | plain blocks | packed blocks | |
| --- | --- | --- | --- |
"""
        + "\n".join(lines),
    )


def both(found: Sequence[Sequence[Item]], directory: Path) -> list[Path]:
    """The recording with plain blocks and with packed ones."""
    files = []
    for name, encode in (("plain", plain_block), ("packed", encode_block)):
        (there := directory / name).mkdir()
        files.append(write(found, encode, there))
    return files


def tell(path: Path) -> None:
    """Print the bytes of one recording, with plain blocks and with packed ones."""
    found = chunks(path)
    with tempfile.TemporaryDirectory() as directory:
        print(f"{path}: {path.stat().st_size / numbers(found):.3f} bytes a number as it is\n")
        print(bytes_table(found, *both(found, Path(directory))))


WORK = (
    ("decompressing and CRC alone", decompress_and_check),
    ("reading: all events and results checked and decoded", read),
    ("replay: reading, the pipeline, results compared", replay),
    ("integrity: the audit's pass over every byte", check),
)

if __name__ == "__main__":
    for argument in sys.argv[1:]:
        tell(Path(argument))
