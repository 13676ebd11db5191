"""The golden recordings: their directories, and the results that a replay gives.

`python -m tests.replay.golden_files` writes each expected.json anew. Run it only after a change that is meant to change
results. `python -m tests.replay.golden_files make` first makes the directory of the present format of the state, with a
recording and a store. Do this once, with the last version that writes this format.
"""

from __future__ import annotations

import heapq
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as in every entry point of the product; must be set before numpy is loaded

from agent.audit.engines import Engines
from agent.audit.replaying import Replayer
from agent.core.events import DeviceChange, Event
from agent.core.pipeline import Pipeline
from agent.core.snapshot import VERSION
from agent.recording.fingerprint import fingerprint
from agent.recording.reading import RecordingReader
from benchmarks.online.clamp import blocks
from benchmarks.online.runner import ticked
from hw.block import SampleBlock
from hw.virtual.noise import Stream
from hw.virtual.timebase import Clock
from tests import golden_site
from tests.unit.recorded_bench import EPOCH_NS, record_events

GOLDEN = Path(__file__).parent / "golden"
FORMATS = sorted(GOLDEN.iterdir())
RECORDING, STATE, EXPECTED = "fieldcal-000001.mcap", "state.sqlite", "expected.json"
DURATION_S, SEED = 27.0, 1


def results_of(path: Path) -> list[dict[str, Any]]:
    """All results of a replay, in order, as they are after JSON encoding and decoding."""
    replay = Replayer(Engines(Pipeline.restore), fingerprint(), elsewhere=0.0).run(path)
    file = replay.file
    assert not file.refused, file.refused
    assert file.fault is None
    found = sorted([*replay.windows, *replay.calibrations], key=lambda result: result.sequence)
    return [json.loads(msgspec.json.encode({"what": type(r).__name__, **msgspec.structs.asdict(r)})) for r in found]


def config_of(path: Path) -> str:
    """The configuration in a recording's RunStart, as JSON text."""
    start = next(step.event for step in RecordingReader(path).steps())
    return str(start.config_json)  # type: ignore[union-attr] - the reader ensures that the first event is a RunStart


def make(directory: Path) -> None:
    """Write a recording of the golden site, and the store with the state that a gateway keeps after it."""
    record_events(directory, golden_site.golden_config(), _events(), "golden")
    for path in directory.iterdir():
        if path.name not in (RECORDING, STATE):
            path.unlink()


def _events() -> Iterator[Event]:
    """Openings, then the blocks of both devices and the ticks in order of time."""
    streams = {golden_site.SENSOR: Stream.SENSOR_ARRIVAL, golden_site.REFERENCE: Stream.REFERENCE_ARRIVAL}
    for device in streams:
        info = json.dumps(msgspec.to_builtins(golden_site.info(device)))
        yield DeviceChange(device=device, state="open", t_monotonic_ns=0, t_utc_ns=EPOCH_NS, info_json=info)
    streams = [
        _blocks(golden_site.SENSOR, Stream.SENSOR_ARRIVAL),
        _blocks(golden_site.REFERENCE, Stream.REFERENCE_ARRIVAL),
    ]
    yield from ticked(heapq.merge(*streams, key=lambda block: block.t_monotonic_ns))


def _blocks(device: str, stream: Stream) -> Iterator[SampleBlock]:
    rate_hz, late = golden_site.RATE_HZ, golden_site.LATE
    stamp_s = late.stamps(Clock(rate_hz), late.arrivals(SEED, stream, DURATION_S))
    return blocks(device, stamp_s, golden_site.World(SEED).values(device, 0, len(stamp_s)), rate_hz)


if __name__ == "__main__":
    if sys.argv[1:] == ["make"]:
        make(GOLDEN / f"format-{VERSION}")
    for directory in sorted(GOLDEN.iterdir()):
        results = results_of(directory / RECORDING)
        (directory / EXPECTED).write_text(json.dumps(results, indent=1) + "\n")
        print(directory / EXPECTED, len(results), "results")
