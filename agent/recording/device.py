"""Driver `replay`: plays a device of a recording as if it were connected, as fast as recorded, or slower or faster."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from agent.core.events import DeviceChange, Event, RunStart
from agent.recording.reading import RecordingReader, first_event
from hw.block import BlockFlags, DeviceInfo, Drop, SampleBlock
from hw.data_time import DataClock, together
from hw.sensor import Clock, ConfigurationError, DeviceLost, Options, boot_id, system_clock

BLOCK_S = 0.5


class ReplayOptions(Options):
    """Options of `replay`. Devices with the same recordings and the same speed share one clock: they stay in step."""

    recordings: tuple[Path, ...] = Field(min_length=1, description="files (.mcap) of one run, in order")
    device: str = Field("", description="name of the device in the recording; by default the name of this device")
    speed: float = Field(1.0, gt=0, le=1000, description="playing speed; 2: twice as fast as recorded, stamps included")


class PlayClock:
    """Converts the recording's time to this machine's. Playing begins when the first of the devices is opened."""

    def __init__(self, clock: Clock, speed: float) -> None:
        self.data = DataClock(clock, speed)
        self._shift_ns: int | None = None

    def begin(self, recorded_ns: int) -> None:
        """Start playing: the recording's time `recorded_ns` is now. Does nothing if it plays already."""
        if self._shift_ns is None:
            self._shift_ns = self.data()[0] - recorded_ns

    @property
    def shift_ns(self) -> int:
        """Nanoseconds to add to the recording's CLOCK_MONOTONIC to get this machine's."""
        return self._shift_ns or 0


class Replay:
    """Gives the recorded blocks with their bursts, counts and flags.

    Time stamps are shifted to this machine's clock; sample indices are counted anew. Where the device was lost in the
    recording it is lost here too, and it can be opened again when it came back in the recording. Samples that are due
    while the device is closed are skipped. After the end of the recording no samples come.
    """

    options_model: ClassVar[type[Options]] = ReplayOptions

    def __init__(
        self,
        name: str,
        options: ReplayOptions,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._name = name
        self._recorded_name = options.device or name
        self._options = options
        key = (clock, options.recordings, options.speed)
        self._play = together(key, lambda: PlayClock(clock, options.speed))
        self._clock, self._sleep = self._play.data, self._play.data.slowed(sleep)
        self._events: Iterator[Event] | None = None
        self._coming: Event | None = None
        self._info: DeviceInfo | None = None  # of the device while the recording says that it is connected
        self._absence = "not opened yet"
        self._opened = False
        self._index = 0  # of the next sample
        self._offset: int | None = None  # to add to a recorded sample index
        self._drops: list[Drop] = []

    def open(self) -> DeviceInfo:
        """Open the device.

        Raises DeviceLost where a file is missing or the recorded device was not connected at this moment,
        ConfigurationError where the files are not recordings of one run that has this device.
        """
        self.close()
        if self._events is None:
            start = self._begin()
            self._events = self._recorded()
            self._play.begin(start.t_monotonic_ns)
        for path in self._options.recordings:
            if not path.is_file():
                raise DeviceLost(f"{path}: no such file")
        until_ns = self._clock()[0] + round(BLOCK_S * 1e9)
        while self._due_within(self._clock()[0] if self._info else until_ns):
            self._pass()
        if self._info is None:
            raise DeviceLost(f"{self._options.recordings[0]}: device {self._recorded_name!r}: {self._absence}")
        self._opened = True
        self._offset = None
        return self._info

    def read_block(self) -> SampleBlock | None:
        """Wait for the next block and return it; None where no block is due within BLOCK_S. Raises DeviceLost."""
        end_ns = self._clock()[0] + round(BLOCK_S * 1e9)
        while self._opened and self._info is not None:
            if not self._due_within(end_ns):
                self._sleep((end_ns - self._clock()[0]) * 1e-9)
                return None
            event = self._pass()
            if isinstance(event, SampleBlock) and event.device == self._recorded_name:
                return self._shifted(event)
        absence = "not open" if self._info else self._absence
        raise DeviceLost(f"{self._options.recordings[0]}: device {self._recorded_name!r}: {absence}")

    def take_drops(self) -> list[Drop]:
        """The parts of the files that could not be read since the last call."""
        drops, self._drops = self._drops, []
        return drops

    def close(self) -> None:
        """Close the device. The recording's time goes on while it is closed."""
        self._opened = False

    def _begin(self) -> RunStart:
        """Return the first file's RunStart; check that all files are of one run and that the run has the device."""
        starts: list[RunStart] = []
        for path in self._options.recordings:
            start = first_event(path)
            if start is None and not path.is_file():
                raise DeviceLost(f"{path}: no such file")
            if start is None:
                raise ConfigurationError(f"{path}: not a recording made by fieldcal")
            starts.append(start)
            if start.run_id != starts[0].run_id:
                raise ConfigurationError(
                    f"{path}: belongs to run {start.run_id}, but the first file to run {starts[0].run_id}; "
                    f"give files of one run only"
                )
        if starts[0].continuation:
            where = self._options.recordings[0]
            raise ConfigurationError(f"{where}: the run began in an earlier file; begin with the first file of the run")
        names = [device["name"] for device in json.loads(starts[0].config_json)["devices"]]
        if self._recorded_name not in names:
            where = self._options.recordings[0]
            raise ConfigurationError(f"{where}: no device {self._recorded_name!r}; its devices are {', '.join(names)}")
        return starts[0]

    def _recorded(self) -> Iterator[Event]:
        """Events of all files in order."""
        for path in self._options.recordings:
            reader = RecordingReader(path)
            for step in reader.steps():
                yield step.event
            if reader.fault is not None:
                unread = path.stat().st_size - reader.good_bytes
                self._drops.append(Drop(unread, "bytes", f"{path}: {reader.fault}"))

    def _due_within(self, end_ns: int) -> bool:
        """Whether the next event is due by `end_ns`; false at the end of the recording."""
        if self._coming is None and self._events is not None:
            self._coming = next(self._events, None)
        return self._coming is not None and self._due_ns(self._coming) <= end_ns

    def _pass(self) -> Event:
        """Wait until the next event is due and return it; note whether the device was connected from then on."""
        event, self._coming = self._coming, None
        assert event is not None  # the caller has asked `_due_within`
        self._sleep(max(0.0, (self._due_ns(event) - self._clock()[0]) * 1e-9))
        if isinstance(event, DeviceChange) and event.device == self._recorded_name:
            if event.state == "open":
                recorded = DeviceInfo(**json.loads(event.info_json))
                self._info = replace(recorded, driver="replay", own_clock=self._options.speed != 1.0)
            else:
                self._info, self._absence = None, event.message
        return event

    def _due_ns(self, event: Event) -> int:
        return event.t_monotonic_ns + self._play.shift_ns

    def _shifted(self, block: SampleBlock) -> SampleBlock:
        """The block with stamps, boot identifier and sample index as if it had been read on this machine now."""
        flags = block.flags
        if self._offset is None:
            self._offset = self._index - block.first_index
            flags |= BlockFlags.RESTART
        first_index = block.first_index + self._offset
        self._index = first_index + block.n
        arrivals_ns = block.burst_t_monotonic_ns + self._play.shift_ns
        now_ns, utc_ns = self._clock()
        return replace(
            block,
            device=self._name,
            boot_id=boot_id(),
            t_utc_ns=utc_ns - now_ns + int(arrivals_ns[-1]),
            first_index=first_index,
            burst_t_monotonic_ns=arrivals_ns,
            flags=flags,
        )
