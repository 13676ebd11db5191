"""Converts events, results and log records of the service to the state that the terminal shows."""

from __future__ import annotations

import logging
import queue
import sys
import time
from collections import deque

from agent.config import Config
from agent.core.events import DeviceChange, Event, Gap, Result, Tick
from agent.delivery.publication import PublicationState
from agent.recording.writer import Recorder
from agent.terminal.next_step import NextSteps
from agent.terminal.quantity import counted
from agent.terminal.state import DeviceState, RecordingState, ShownTruth, ViewState
from agent.terminal.view import open_view
from agent.terminal.wording import gap_line
from hw.block import BlockFlags, SampleBlock

_log = logging.getLogger(__name__)
SLOW_TOLD_S = 10.0  # s between two lines that this computer is too slow
SLOW_REMEDY = "end other programs; --rate-hz 250 asks less of it than 1000"
RATE_OVER_BLOCKS = 20  # the shown rate is a mean over this many blocks, ten seconds


class RunView(logging.Handler):
    """The view of a run. Only the main loop calls `update` and `health`; `say` and log records may come from any
    thread.

    `lines`: whether what happens is written where there is no terminal; a log that tells it makes them superfluous.
    """

    def __init__(self, config: Config, title: str, truth: ShownTruth | None, *, lines: bool = True) -> None:
        super().__init__(logging.WARNING)
        gateway = config.gateway
        self._lines = lines
        self.state = ViewState(title=title, gateway=f"{gateway.site}/{gateway.name}")
        self.state.devices = {d.name: DeviceState(kind=d.driver) for d in config.devices}
        if truth is not None:
            self.state.truths = {channel.sensor: truth for channel in config.channels}
        self._arrivals: dict[str, deque[tuple[int, int]]] = {
            d.name: deque(maxlen=RATE_OVER_BLOCKS) for d in config.devices
        }
        self._guide = NextSteps(config, turns_itself=truth is not None)
        self._said: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._began_s = time.monotonic()
        self._simulated, self._told_slow_s = truth is not None, -SLOW_TOLD_S

    def __enter__(self) -> RunView:
        self._view = open_view(self.state, sys.stdout, lines=self._lines)
        logging.getLogger("agent").addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger("agent").removeHandler(self)
        self._take_said()
        self._view.close()

    def emit(self, record: logging.LogRecord) -> None:
        """Show a log record of this program as a line."""
        self._said.put(record.getMessage())

    def say(self, line: str) -> None:
        """Show a line and write it to the log."""
        _log.info("%s", line)
        self._said.put(line)

    def update(self, event: Event, results: list[Result]) -> None:
        """Take an event and its results."""
        if isinstance(event, SampleBlock):
            self._take_block(event)
        elif isinstance(event, DeviceChange):
            self._take_change(event)
        elif isinstance(event, Gap):
            self.state.devices[event.device].gaps += 1
            self._tell_gap(event)
        self.state.take(results)
        self._advise(event, results)
        self._take_said()
        self._view.refresh(now=bool(results))

    def _tell_gap(self, gap: Gap) -> None:
        """A virtual device loses samples because the computer is busy: that is told once in a while, with the cause."""
        if not self._simulated:
            self._said.put(gap_line(gap))
        elif (now_s := time.monotonic()) - self._told_slow_s > SLOW_TOLD_S:
            self._told_slow_s = now_s
            gaps = counted(sum(device.gaps for device in self.state.devices.values()), "gaps")
            self._said.put(f"this computer is too slow for the simulation: {gaps} in the samples so far; {SLOW_REMEDY}")

    def health(self, recorder: Recorder, publication: PublicationState | None) -> None:
        """Take the state of recording and publication, once a second."""
        self.state.uptime_s = time.monotonic() - self._began_s
        self.state.publication = publication
        path = recorder.path
        if path is not None:
            self.state.recording = RecordingState(str(path), recorder.size_bytes, recording=True)
        elif self.state.recording is not None:
            self.state.recording.recording = False
        self._view.refresh()

    def _advise(self, event: Event, results: list[Result]) -> None:
        if not results and isinstance(event, (SampleBlock, Tick)):
            return  # what comes next follows from devices, commands and results
        for sensor, step in self._guide.update(event, results).items():
            if self.state.next_steps.get(sensor) != step:
                self.state.next_steps[sensor] = step
                _log.info("%s: next: %s", sensor, step)

    def _take_said(self) -> None:
        while not self._said.empty():
            self.state.say(self._said.get())

    def _take_block(self, block: SampleBlock) -> None:
        device = self.state.devices[block.device]
        arrivals = self._arrivals[block.device]
        device.blocks += 1
        if block.flags & (BlockFlags.GAP | BlockFlags.OVERRUN) or (block.flags & BlockFlags.RESTART and arrivals):
            device.gaps += 1
        if block.flags & BlockFlags.RESTART:
            arrivals.clear()
        arrivals.append((block.first_index + block.n, block.t_monotonic_ns))
        elapsed_ns = arrivals[-1][1] - arrivals[0][1]
        if elapsed_ns:
            device.rate_hz = (arrivals[-1][0] - arrivals[0][0]) * 1e9 / elapsed_ns

    def _take_change(self, change: DeviceChange) -> None:
        device = self.state.devices[change.device]
        device.state = "lost" if change.state == "lost" else "open"
        if change.state == "open":
            device.kind = change.message
            self._arrivals[change.device].clear()
        else:
            device.rate_hz = 0.0
            self._said.put(f"{change.device}: {change.message}")
