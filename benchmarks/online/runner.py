"""Feeds the events of a virtual world into the pipeline as fast as possible; records them on request."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Protocol

from agent import __version__
from agent.config import Config
from agent.core.events import Acceleration, DeviceChange, Event, Output, Result, RunStart, Tick
from agent.core.pipeline import Pipeline
from agent.engine import identity
from agent.recording.fingerprint import fingerprint, versions
from agent.recording.writer import Recorder
from hw.block import DeviceInfo, SampleBlock

EPOCH_NS = 1_790_000_000_000_000_000  # UTC at time 0 of the world
TICK_NS = 1_000_000_000
# With visits an hour apart, one tick per second would be most of the events; a few are enough to advance the time.
LATE_S = 8.0  # time after a visit after which late samples are refused


class Visited(Protocol):
    """A world with data at visits only, such as hw.virtual.building."""

    def infos(self) -> dict[str, DeviceInfo]: ...
    def span(self, visit: int) -> tuple[float, float]: ...
    def visit(self, visit: int) -> list[SampleBlock]: ...


class Run:
    """One run of the pipeline. The recording is written into `directory`, which must exist, unless it is None."""

    def __init__(self, config: Config, directory: Path | None = None) -> None:
        self.pipeline = Pipeline.begin(config, "run-1", 0, 0, {})
        self.events = 0
        self.now_ns = 0
        self._recorder: Recorder | None = None
        if directory is not None:
            devices = [device.name for device in config.devices]
            sensors = [channel.sensor for channel in config.channels]
            self._recorder = Recorder(directory, devices, sensors, max_bytes=1 << 40, max_age_s=1e12)
            start = RunStart(
                run_id="run-1", site=config.gateway.site, gateway=config.gateway.name, boot_id="boot",
                t_monotonic_ns=0, t_utc_ns=EPOCH_NS, config_json=config.model_dump_json(),
                versions={"fieldcal": __version__, **versions()}, fingerprint=fingerprint(),
                snapshot=self.pipeline.snapshot(), file_sequence=1, event_sequence=0, engine=identity.name(),
            )  # fmt: skip
            self._record(start, self.pipeline.step(start))

    @property
    def now_s(self) -> float:
        """Time of the newest event, s of the world's clock."""
        return self.now_ns * 1e-9

    def feed(self, event: Event) -> list[Result]:
        """Step the pipeline and return the results of `event`, without the corrected stream."""
        results = [result for result in self.pipeline.step(event) if not isinstance(result, Acceleration)]
        self.now_ns = max(self.now_ns, event.t_monotonic_ns)
        self.events += 1
        self._record(event, results)
        return results

    def close(self) -> None:
        """Finish the recording, if there is one."""
        if self._recorder is not None:
            self._recorder.close()

    def _record(self, event: Event, results: Sequence[Output]) -> None:
        if self._recorder is not None and not self._recorder.record(self.events, event, results):
            raise OSError(self._recorder.fault)


def opened(infos: dict[str, DeviceInfo], t_ns: int = 0) -> Iterator[DeviceChange]:
    """Events that open the devices."""
    for device, info in infos.items():
        yield DeviceChange(
            device=device,
            state="open",
            t_monotonic_ns=t_ns,
            t_utc_ns=EPOCH_NS + t_ns,
            info_json=json.dumps(asdict(info)),
        )


def visits(world: Visited, numbers: Iterable[int]) -> Iterator[Event]:
    """Openings; then for each visit its blocks with a tick per second, and one tick after all late blocks."""
    yield from opened(world.infos())
    for visit in numbers:
        yield from ticked(world.visit(visit))
        yield tick(min(world.span(visit)[1] + LATE_S, world.span(visit + 1)[0]))


def ticked(blocks: Iterable[SampleBlock]) -> Iterator[Event]:
    """Blocks in order of arrival, with a tick before the first block of each second."""
    now_s: int | None = None
    for block in blocks:
        arrival_s = block.t_monotonic_ns // TICK_NS
        if now_s is not None and arrival_s > now_s:
            yield tick(arrival_s)
        now_s = arrival_s
        yield block


def tick(time_s: float) -> Tick:
    """A tick at `time_s` of the world's clock."""
    now_ns = round(time_s * TICK_NS)
    return Tick(t_monotonic_ns=now_ns, t_utc_ns=EPOCH_NS + now_ns)
