"""The golden recordings: each was made by an engine that is known, and holds the results that this engine gave.

`python -m tests.replay.golden_files` makes the one of the present engine anew, `golden/engine-<number>`. Run it after
NUMBER in agent/engine/identity.py was raised. The others stay as they are.
"""

from __future__ import annotations

import heapq
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as in every entry point of the product; must be set before numpy is loaded

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from agent.core.events import DeviceChange, Event, RunStart
from agent.engine.identity import NUMBER
from agent.engine.known import KnownEngine, known_engines
from agent.recording.reading import RecordingReader
from agent.recording.signing import Signer
from benchmarks.online.clamp import blocks
from benchmarks.online.runner import ticked
from deploy.engines.earlier import NoHistoryError, build
from hw.block import SampleBlock
from hw.virtual.noise import NoiseStream
from hw.virtual.timebase import Clock
from tests import golden_site
from tests.unit.recorded_bench import EPOCH_NS, record_events

GOLDEN = Path(__file__).parent / "golden"
FORMATS = sorted(GOLDEN.glob("format-*"))  # formats 1 to 3 of the state, each with a store
PRESENT = GOLDEN / f"engine-{NUMBER}"
MADE_FORMATS = {"format-1": 3, "format-2": 4, "format-3": 5}  # numbers of their engines
RECORDING, STATE, PUBLIC_KEY = "fieldcal-000001.mcap", "state.sqlite", "gateway.pub"
DURATION_S, SEED = 27.0, 1


def engine_of(directory: Path) -> int:
    """The number of the engine that made a golden recording."""
    return MADE_FORMATS.get(directory.name) or int(directory.name.removeprefix("engine-"))


def engine_wheel(directory: Path) -> tuple[KnownEngine, bytes]:
    """The engine that made a golden recording, and its wheel. Skips the test where the history is not there."""
    # Of one number all give the same results; a golden recording may name one that was never released.
    known = next(known for known in reversed(known_engines()) if known.number == engine_of(directory))
    try:
        return known, build(known.revision, known.number, known.id)
    except NoHistoryError as reason:
        pytest.skip(str(reason))


def start_of(path: Path) -> RunStart:
    """The first event of a recording."""
    start = next(step.event for step in RecordingReader(path).steps())
    assert isinstance(start, RunStart)
    return start


def config_of(path: Path) -> str:
    """The configuration in a recording's RunStart, as JSON text."""
    return start_of(path).config_json


def make(directory: Path) -> None:
    """Write a recording of the golden site, signed, and the public key."""
    shutil.rmtree(directory, ignore_errors=True)
    signer = Signer(Ed25519PrivateKey.generate())
    record_events(directory, golden_site.golden_config(), _events(), "golden", signer)
    for path in directory.iterdir():
        if path.name != RECORDING:
            path.unlink()
    public = signer.public_key.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    (directory / PUBLIC_KEY).write_bytes(public)


def _events() -> Iterator[Event]:
    """Openings, then the blocks of both devices and the ticks in order of time."""
    streams = {golden_site.SENSOR: NoiseStream.SENSOR_ARRIVAL, golden_site.REFERENCE: NoiseStream.REFERENCE_ARRIVAL}
    for device in streams:
        info = json.dumps(msgspec.to_builtins(golden_site.info(device)))
        yield DeviceChange(device=device, state="open", t_monotonic_ns=0, t_utc_ns=EPOCH_NS, info_json=info)
    blocks = [
        _blocks(golden_site.SENSOR, NoiseStream.SENSOR_ARRIVAL),
        _blocks(golden_site.REFERENCE, NoiseStream.REFERENCE_ARRIVAL),
    ]
    yield from ticked(heapq.merge(*blocks, key=lambda block: block.t_monotonic_ns))


def _blocks(device: str, stream: NoiseStream) -> Iterator[SampleBlock]:
    rate_hz, late = golden_site.RATE_HZ, golden_site.LATE
    stamp_s = late.stamps(Clock(rate_hz), late.arrivals(SEED, stream, DURATION_S))
    return blocks(device, stamp_s, golden_site.World(SEED).values(device, 0, len(stamp_s)), rate_hz)


if __name__ == "__main__":
    make(PRESENT)
    print(PRESENT / RECORDING, (PRESENT / RECORDING).stat().st_size, "bytes")
