"""A run of the virtual bench as an agent records it, without ports and faster than real time."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from agent import __version__
from agent.config import Config, parse_config
from agent.core.events import DeviceChange, Event, Result, RunStart, Tick
from agent.core.pipeline import Pipeline
from agent.delivery.history import StoredResult
from agent.delivery.store import Store
from agent.engine import identity
from agent.recording.fingerprint import fingerprint, versions
from agent.recording.signing import Signer
from agent.recording.writer import Recorder
from hw.block import DeviceInfo, SampleBlock
from hw.virtual.bench import Bench, Truth
from hw.virtual.presets import COUNTS_PER_MPS2, plain

EPOCH_NS = 1_790_000_000_000_000_000
BLOCK, BURST = 500, 25
PRIOR = {"sensitivity": COUNTS_PER_MPS2}


def record(data_dir: Path, duration_s: float, seed: int = 7, run_id: str = "run-1", **channel: Any) -> Truth:
    """StoredResult the plain preset's first `duration_s` into a data directory with store and one recording."""
    bench = Bench(plain(seed), seed)
    record_events(data_dir, _config(bench, **channel), _events(bench, duration_s), run_id)
    return bench.truth


def record_events(
    data_dir: Path,
    config: Config,
    events: Iterable[Event],
    run_id: str,
    signer: Signer | None = None,
    begun_ns: int = EPOCH_NS,
) -> None:
    """Feed a new pipeline with the events; write recording and store into a data directory."""
    data_dir.mkdir(parents=True, exist_ok=True)
    pipeline = Pipeline.begin(config, run_id, 0, 0, {})
    devices, sensors = [d.name for d in config.devices], [c.sensor for c in config.channels]
    store = Store(data_dir, 0)
    store.mark_file(1)
    recorder = Recorder(data_dir, devices, sensors, signer=signer, epoch=store.epoch)
    start = RunStart(
        run_id=run_id, site=config.gateway.site, gateway=config.gateway.name, boot_id="boot", t_monotonic_ns=0,
        t_utc_ns=begun_ns, config_json=config.model_dump_json(), versions={"fieldcal": __version__, **versions()},
        fingerprint=fingerprint(), snapshot=pipeline.snapshot(), file_sequence=1, event_sequence=0,
        engine=identity.name(),
    )  # fmt: skip
    recorder.record(0, start, pipeline.step(start))
    assert recorder.path is not None
    name = recorder.path.name.removesuffix(".active")
    for number, event in enumerate(events, start=1):
        results = pipeline.step(event)
        assert recorder.record(number, event, results)
        kept = [r for r in results if isinstance(r, Result)]
        store.commit([StoredResult.of(r, recorded=True, recording=name) for r in kept], pipeline.memories(results))
    recorder.close()
    store.close()


def _config(bench: Bench, **channel: Any) -> Config:
    poses = [
        {"start_s": p.start_s, "stop_s": p.stop_s, "theta_deg": p.theta_deg, "alpha_deg": p.alpha_deg}
        for p in bench.poses
    ]
    port = {"port": "/dev/null", "rate_hz": 1000.0, "unit": "count"}
    raw = {
        "gateway": {"site": "virtual", "name": "bench"},
        "devices": [
            {"name": "mems", "driver": "serial-csv", "options": port | {"axes": 3}},
            {"name": "reference", "driver": "serial-csv", "options": port | {"axes": 1, "unit": "m/s2"}},
        ],
        "channels": [{"sensor": "mems", "reference": "reference", "prior": PRIOR, "poses": poses, **channel}],
        "zenoh": {"enabled": False},
    }
    return parse_config(raw, "bench")


def _events(bench: Bench, duration_s: float) -> Iterator[Event]:
    """Openings, then the blocks of both devices and the ticks in order of time."""
    recording = bench.recording(duration_s)
    for device, axes, unit in (("mems", 3, "count"), ("reference", 1, "m/s2")):
        info = DeviceInfo("serial-csv", "virtual", f"{device}-1", unit, axes, 1000.0)  # type: ignore[arg-type]
        held = json.dumps(msgspec.to_builtins(info))
        yield DeviceChange(device=device, state="open", t_monotonic_ns=0, t_utc_ns=EPOCH_NS, info_json=held)
    events: list[Event] = [
        *_blocks("mems", recording.sensor_time_s, recording.v),
        *_blocks("reference", recording.reference_time_s, recording.reference),
        *(Tick(t_monotonic_ns=s * 10**9, t_utc_ns=EPOCH_NS + s * 10**9) for s in range(1, int(duration_s))),
    ]
    yield from sorted(events, key=lambda event: event.t_monotonic_ns)


def _blocks(device: str, time_s: np.ndarray, values: np.ndarray) -> Iterator[SampleBlock]:
    for first in range(0, len(time_s) - BLOCK + 1, BLOCK):
        count = np.arange(BURST, BLOCK + 1, BURST, dtype=np.int32)
        arrival_ns = np.round(time_s[first + count - 1] * 1e9).astype(np.int64)
        yield SampleBlock(
            device, "boot", EPOCH_NS + int(arrival_ns[-1]), first, 1000.0, arrival_ns, count,
            np.ascontiguousarray(values[first : first + BLOCK], dtype=np.float64),
        )  # fmt: skip
