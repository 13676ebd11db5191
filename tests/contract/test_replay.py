"""The driver contract on `replay`, and which recordings the driver accepts."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.core.events import DeviceChange, Event, Tick
from agent.recording.device import Replay, ReplayOptions
from agent.recording.reading import RecordingReader
from hw.block import BlockFlags, DeviceInfo, SampleBlock
from hw.conformance.sensor import Rig, SensorContract
from hw.sensor import GOLDEN, ConfigurationError, DeviceLost
from tests.unit.recorded_bench import EPOCH_NS, record

FULL = 2**19 - 1
BURST_S, BURSTS = 0.02, 21
INFO = DeviceInfo("adxl355", "ADXL355", "17", "count", 3, 1000.0)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of six seconds of the bench, with the devices `mems` and `reference`."""
    directory = tmp_path_factory.mktemp("recorded")
    record(directory, 6.0)
    return next(directory.glob("*.mcap"))


class ReplayRig(Rig):
    """The recording is generated while it is played; each event is made when the driver asks for it."""

    def __init__(self, recording: Path) -> None:
        self.saturated = range(0)
        self.plugged = True
        self.lost = 0
        self.recording = recording
        self.sensor: Replay = self.build()

    def build(self, **options: Any) -> Replay:
        rig = self

        class Endless(Replay):
            def _recorded(self) -> Iterator[Event]:
                return rig.events()

        given = ReplayOptions.model_validate({"recordings": [self.recording], "device": "mems"} | options)
        return Endless("sensor", given, clock=self.clock, sleep=lambda s: self.sleep(s))

    def build_elsewhere(self) -> Replay:
        return self.build(recordings=["/no/such/file.mcap"])

    def events(self) -> Iterator[Event]:
        """Events that an agent would have recorded of the device: its blocks, its losses and openings, and ticks."""
        t_s, phase, made, there, lost, flags = 0.0, 0.0, 0, False, 0, BlockFlags.NONE
        while True:
            if self.plugged != there:
                there = self.plugged
                yield self.change("open" if there else "lost", t_s)
                made, flags = self.due(t_s), BlockFlags.RESTART
            first, arrivals_ns, counts = made + self.lost - lost, [], []
            flags |= BlockFlags.GAP if self.lost > lost else BlockFlags.NONE
            lost = self.lost
            speaking = there and self.due(t_s + BURST_S) > made
            for _ in range(BURSTS if speaking else BURSTS // 8):
                phase = (phase + GOLDEN) % 1.0
                t_s += BURST_S + phase / self.rate_hz
                if there and self.due(t_s) > max(made, first):
                    made = self.due(t_s)
                    arrivals_ns.append(round(t_s * 1e9))
                    counts.append(made - first)
            if counts:
                yield SampleBlock(
                    "mems", "boot", EPOCH_NS + arrivals_ns[-1], first, self.rate_hz, np.array(arrivals_ns),
                    np.array(counts, np.int32), self.counts(first, counts[-1]), flags | self.ends(first, counts[-1]),
                )  # fmt: skip
                flags = BlockFlags.NONE
            yield Tick(t_monotonic_ns=round(t_s * 1e9), t_utc_ns=EPOCH_NS)

    def change(self, state: Literal["open", "lost"], t_s: float) -> DeviceChange:
        info = json.dumps(asdict(INFO)) if state == "open" else ""
        return DeviceChange(
            device="mems", state=state, t_monotonic_ns=round(t_s * 1e9), t_utc_ns=0, message="gone", info_json=info
        )

    def counts(self, first: int, n: int) -> NDArray[np.int32]:
        k = np.arange(first, first + n, dtype=np.int32)
        return np.column_stack([k % 1000, k // 1000, np.where(np.isin(k, self.saturated), FULL, -1)]).astype(np.int32)

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = indications.astype(np.int64).T
        numbers = x + 1000 * y
        assert ((z == -1) | ((z == FULL) & np.isin(numbers, self.saturated))).all()
        return np.asarray(numbers)

    def ends(self, first: int, n: int) -> BlockFlags:
        reached = any(first <= i < first + n for i in self.saturated)
        return BlockFlags.SATURATED if reached else BlockFlags.NONE

    def saturate(self, first: int, last: int) -> None:
        self.saturated = range(first, last + 1)

    def lose(self) -> None:
        self.lost += 3

    def unplug(self) -> None:
        self.plugged = False

    def replug(self) -> None:
        self.plugged = True

    def close(self) -> None:
        self.sensor.close()


class TestReplay(SensorContract):
    @pytest.fixture
    def rig(self, recording: Path) -> Iterator[ReplayRig]:
        rig = ReplayRig(recording)
        yield rig
        rig.close()

    def test_what_came_before_the_loss_is_returned_first(self, rig: Rig) -> None:
        # Blocks are played as they were recorded: the last one is that before the loss.
        rig.open()
        *_, before = rig.blocks(0.6)
        block = rig.sensor.read_block()
        assert block is not None
        assert block.first_index == before.first_index + before.n
        rig.unplug()
        with pytest.raises(DeviceLost, match="device 'mems': gone"):
            rig.sensor.read_block()


class Machine:
    t_s = 500.0

    def clock(self) -> tuple[int, int]:
        ns = round(self.t_s * 1e9)
        return ns, 10**18 + ns

    def sleep(self, seconds: float) -> None:
        self.t_s += seconds

    def build(self, *recordings: Path, name: str = "mems", **options: Any) -> Replay:
        given = ReplayOptions.model_validate({"recordings": recordings} | options)
        return Replay(name, given, clock=self.clock, sleep=self.sleep)


def recorded_blocks(path: Path, device: str) -> list[SampleBlock]:
    events = (step.event for step in RecordingReader(path).steps())
    return [event for event in events if isinstance(event, SampleBlock) and event.device == device]


@pytest.mark.parametrize("device", ["mems", "reference"])
def test_every_recorded_sample_comes_again_at_its_place(recording: Path, device: str) -> None:
    machine = Machine()
    sensor = machine.build(recording, name=device)
    info = sensor.open()
    assert (info.driver, info.serial_number, info.unit) == (
        "replay",
        f"{device}-1",
        {"mems": "count"}.get(device, "m/s2"),
    )
    recorded = recorded_blocks(recording, device)
    assert len(recorded) > 10
    for first, block in zip([True] + [False] * len(recorded), recorded, strict=False):
        played = sensor.read_block()
        assert played is not None
        check_stamps(played, block)
        assert machine.t_s == pytest.approx(played.t_monotonic_ns * 1e-9, abs=1e-6)  # not before the block had arrived
        assert played.flags == block.flags | (BlockFlags.RESTART if first else BlockFlags.NONE)
        assert np.array_equal(played.indications, block.indications)
        assert played.indications.dtype == block.indications.dtype
    assert sensor.read_block() is None
    assert sensor.read_block() is None
    assert sensor.take_drops() == []


def check_stamps(played: SampleBlock, block: SampleBlock) -> None:
    """Check that only the times changed: this machine's clock was at 500 s when the recording's clock was at 0."""
    assert np.array_equal(played.burst_t_monotonic_ns, block.burst_t_monotonic_ns + 500 * 10**9)
    assert played.t_utc_ns == 10**18 + played.t_monotonic_ns
    assert np.array_equal(played.burst_count, block.burst_count)
    assert played.first_index == block.first_index
    assert played.boot_id != block.boot_id


def test_devices_play_together(recording: Path) -> None:
    machine = Machine()
    mems, reference = machine.build(recording), machine.build(recording, name="ref", device="reference")
    mems.open()
    machine.sleep(2.2)
    reference.open()
    late = reference.read_block()
    assert late is not None
    # Blocks of half a second: the one from 2.0 to 2.5 s is the first one that ends after the start.
    assert late.t_monotonic_ns == pytest.approx(502.5e9, abs=0.01e9)
    assert (late.device, late.first_index) == ("ref", 0)


def test_faster_than_recorded(recording: Path) -> None:
    machine = Machine()
    sensor = machine.build(recording, speed=10.0)
    sensor.open()
    blocks = [sensor.read_block() for _ in range(8)]
    assert blocks[7] is not None
    assert machine.t_s == pytest.approx(500.4, abs=0.01)
    assert blocks[7].t_monotonic_ns == pytest.approx(504.0e9, abs=0.1e9)


def test_a_recording_that_ends_early(recording: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    sensor = Machine().build(torn)
    sensor.open()
    while sensor.read_block() is not None:
        pass
    (drop,) = sensor.take_drops()
    assert drop.unit == "bytes"
    assert drop.reason.startswith(f"{torn}: byte ")
    assert 0 < drop.count < torn.stat().st_size


def test_files_that_cannot_be_played(recording: Path, tmp_path: Path) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("no recording")
    with pytest.raises(ConfigurationError, match=f"{text}: not a recording made by fieldcal"):
        Machine().build(text).open()
    with pytest.raises(ConfigurationError, match="no device 'mesm'; its devices are mems, reference"):
        Machine().build(recording, name="mesm").open()
    other = tmp_path / "other"
    record(other, 1.0, run_id="run-2")
    (second,) = other.glob("*.mcap")
    with pytest.raises(ConfigurationError, match=f"{second}: belongs to run run-2, but the first file to run run-1"):
        Machine().build(recording, second).open()
