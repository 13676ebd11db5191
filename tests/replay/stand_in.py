"""A small deterministic pipeline, and a run for it, with which recording, replay and audit are tested."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from agent import __version__
from agent.core.events import (
    CalibrationUpdate,
    DeviceChange,
    Event,
    Gap,
    Result,
    RunStart,
    StatusChange,
    Tick,
    WindowReport,
)
from agent.core.memory import Memory
from agent.engine import identity
from agent.recording.fingerprint import fingerprint
from agent.recording.writer import Recorder
from hw.block import BlockFlags, SampleBlock

SECOND = 1_000_000_000
EPOCH_NS = 1_790_000_000 * SECOND
CONFIG = '{"window_blocks": 3}'
here = cache(fingerprint)  # it takes 15 ms where many libraries are loaded
Recorded = tuple[int, Event, list[Result]]


class StandIn:
    """Gives a window for each few blocks, with the blocks' sums of products, and a calibration for each second window.

    BLAS computes the sums, so that they depend on the CPU kernel, as those of the real pipeline do.
    """

    def __init__(self, config_json: str) -> None:
        self.config_json = config_json
        self.window_blocks = int(msgspec.json.decode(config_json)["window_blocks"])
        self.run_id = ""
        self.sequence = self.blocks = self.windows = 0
        self.sums = np.zeros((3, 3))

    @classmethod
    def restore(cls, config_json: str, snapshot: bytes) -> StandIn:
        pipeline = cls(config_json)
        state = msgspec.msgpack.decode(snapshot)
        pipeline.sums = np.frombuffer(state.pop("sums")).reshape(3, 3).copy()
        vars(pipeline).update(state)
        return pipeline

    def snapshot(self) -> bytes:
        names = ("run_id", "sequence", "blocks", "windows")
        return msgspec.msgpack.encode({name: vars(self)[name] for name in names} | {"sums": self.sums.tobytes()})

    def all_memories(self) -> list[Memory]:
        return []

    def step(self, event: Event) -> list[Result]:
        if isinstance(event, RunStart):
            self.run_id = event.run_id
            return [] if event.continuation else [self._status(event.t_utc_ns, "COLLECTING", "UNCALIBRATED")]
        if isinstance(event, DeviceChange) and event.state == "lost":
            return [self._status(event.t_utc_ns, "INVALID", "COLLECTING")]
        return self._block(event) if isinstance(event, SampleBlock) and event.device == "acc" else []

    def _block(self, block: SampleBlock) -> list[Result]:
        self.sums = self.sums + block.indications.T @ np.sqrt(np.abs(block.indications))
        self.blocks += 1
        if self.blocks % self.window_blocks:
            return []
        self.windows += 1
        results: list[Result] = [self._window(block)]
        if self.windows % 2 == 0:
            results.append(self._calibration(block))
        return results

    def _common(self, t_utc_ns: int) -> dict[str, Any]:
        self.sequence += 1
        return {"run_id": self.run_id, "sequence": self.sequence, "sensor": "bridge-1", "t_utc_ns": t_utc_ns}

    def _status(self, t_utc_ns: int, status: Any, before: str) -> StatusChange:
        return StatusChange(**self._common(t_utc_ns), status=status, before=before, reason="as it is")

    def _window(self, block: SampleBlock) -> WindowReport:
        level = float(np.trace(self.sums)) / self.blocks
        return WindowReport(
            **self._common(block.t_utc_ns),
            start_s=block.first_index / 1000.0,
            stop_s=(block.first_index + block.n) / 1000.0,
            position="first",
            used=level > 1e3,
            reason="" if level > 1e3 else "too quiet",
            points=block.n,
            left_out=0,
            numbers={"level_counts2": level, "level_counts2_threshold": 1e3, "coherence": float("nan")},
        )

    def _calibration(self, block: SampleBlock) -> CalibrationUpdate:
        sensitivity = self.sums / self.sums[2, 2]
        covariance = np.zeros((12, 12))
        covariance[:3, :3] = sensitivity
        return CalibrationUpdate(
            **self._common(block.t_utc_ns),
            sensitivity=sensitivity.tolist(),
            offset=[-0.0, float("nan"), float("inf")],
            standard_uncertainty=[0.1 * k for k in range(12)],
            covariance=covariance.tolist(),
            coverage_factor=2.0,
            determined=[True] * 11 + [False],
            method="stand-in",
            uncertainty_kind="type A, white",
            windows=self.windows,
            residual_sd=[0.1, 0.2, 0.3],
            output_unit="count",
            identity="ADXL355 0123",
        )


def block(device: str, number: int, rng: np.random.Generator, n: int = 20) -> SampleBlock:
    """The `number`-th block of a device: three axes of counts from "acc", one of decimals from any other."""
    counts = rng.integers(-(2**19), 2**19, (n, 3), dtype=np.int32)
    arrival_ns = 5 * SECOND + number * SECOND // 2
    return SampleBlock(
        device=device,
        boot_id="boot-1",
        t_utc_ns=EPOCH_NS + arrival_ns,
        first_index=number * n,
        nominal_rate_hz=1000.0,
        burst_t_monotonic_ns=np.array([arrival_ns - 7_000_000, arrival_ns], np.int64),
        burst_count=np.array([n // 2, n], np.int32),
        indications=counts if device == "acc" else rng.normal(0.0, 1.0, (n, 1)),
        flags=BlockFlags.SATURATED if number == 3 else BlockFlags.NONE,
        temperature_raw=1885 if device == "acc" else None,
    )


def happenings(blocks: int, seed: int) -> Iterator[Event]:
    """Events of a run without its RunStart: blocks of two devices, a tick each second, one event of each other kind."""
    rng = np.random.default_rng(seed)
    for number in range(blocks):
        now_ns = 5 * SECOND + number * SECOND // 2
        yield block("acc", number, rng)
        yield block("ref", number, rng)
        if number % 2:
            yield Tick(t_monotonic_ns=now_ns, t_utc_ns=EPOCH_NS + now_ns)
        if number == 4:
            yield Gap(device="acc", t_monotonic_ns=now_ns, dropped=32, unit="samples", reason="overrun")
            yield DeviceChange(device="acc", state="lost", t_monotonic_ns=now_ns, t_utc_ns=EPOCH_NS + now_ns)


def run_start(pipeline: StandIn, event_sequence: int, file_sequence: int, now_ns: int = 5 * SECOND) -> RunStart:
    """RunStart of the first file (event 0) or of a file that continues the run."""
    return RunStart(
        run_id="run-1",
        site="site",
        gateway="gateway",
        boot_id="boot-1",
        t_monotonic_ns=now_ns,
        t_utc_ns=EPOCH_NS + now_ns,
        config_json=pipeline.config_json,
        versions={"fieldcal": __version__},
        fingerprint=here(),
        snapshot=pipeline.snapshot(),
        file_sequence=file_sequence,
        event_sequence=event_sequence,
        continuation=event_sequence > 0,
        engine=identity.name(),
    )


def record_run(
    directory: Path, *, blocks: int = 12, rotate_at: Sequence[int] = (), seed: int = 1, close: bool = True
) -> list[Recorded]:
    """Record a run, with a new file before each event number in `rotate_at`; returns all that was recorded."""
    recorder = Recorder(directory, ["acc", "ref"], ["bridge-1"])
    pipeline = StandIn(CONFIG)
    recorded: list[Recorded] = []

    def feed(event: Event) -> None:
        results = pipeline.step(event)
        recorded.append((len(recorded), event, results))
        assert recorder.record(*recorded[-1]), recorder.fault

    feed(run_start(pipeline, 0, recorder.next_file_sequence))
    for event in happenings(blocks, seed):
        if len(recorded) in rotate_at:
            feed(run_start(pipeline, len(recorded), recorder.next_file_sequence, event.t_monotonic_ns))
        feed(event)
    recorder.close() if close else recorder.sync()
    return recorded
