"""The driver `replay` plays the devices of a recording into a pipeline, which gives the recorded S and Q."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from agent.core.events import CalibrationUpdate, DeviceChange, Event
from agent.core.pipeline import Pipeline
from agent.recording.device import Replay, ReplayOptions
from agent.recording.reading import RecordingReader
from hw.virtual.bench import Bench
from hw.virtual.presets import plain
from tests.unit.recorded_bench import EPOCH_NS, _config, record

START_NS = 500 * 10**9


class Machine:
    """A simulated clock for one of the devices, which is played without the other one."""

    t_ns = START_NS

    def clock(self) -> tuple[int, int]:
        return self.t_ns, self.t_ns - START_NS + EPOCH_NS

    def sleep(self, seconds: float) -> None:
        self.t_ns += round(seconds * 1e9)


def played(path: Path, name: str) -> list[Event]:
    machine = Machine()
    device = Replay(name, ReplayOptions(recordings=(path,)), clock=machine.clock, sleep=machine.sleep)
    info = json.dumps(asdict(device.open()))
    events: list[Event] = [
        DeviceChange(device=name, state="open", t_monotonic_ns=START_NS, t_utc_ns=EPOCH_NS, info_json=info)
    ]
    while (block := device.read_block()) is not None:
        events.append(block)
    return events


def test_the_same_calibrations_come_out(tmp_path: Path) -> None:
    record(tmp_path, 57.0)
    (path,) = tmp_path.glob("*.mcap")
    steps = list(RecordingReader(path).steps())
    recorded = [result for step in steps for result in step.results if isinstance(result, CalibrationUpdate)]

    pipeline = Pipeline.begin(_config(Bench(plain(7), 7)), "again", START_NS, 0, {})
    events = sorted([*played(path, "mems"), *played(path, "reference")], key=lambda event: event.t_monotonic_ns)
    results = [result for event in events for result in pipeline.step(event)]
    again = [result for result in results if isinstance(result, CalibrationUpdate)]
    assert len(again) == len(recorded) >= 1
    for then, now in zip(recorded, again, strict=True):
        # bit for bit: the shift of the clock is a whole number of ns
        assert (now.sensitivity, now.offset, now.covariance) == (then.sensitivity, then.offset, then.covariance)
