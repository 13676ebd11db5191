"""Reads a recording for a report: results, devices, and windows that are computed again from the raw blocks."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from agent.config import Channel, Config, recorded_config
from agent.core.driver_filters import DriverFilters
from agent.core.events import CalibrationUpdate, DeviceChange, Event, Output, RunStart, StatusChange, WindowReport
from agent.core.schedule import pieces
from agent.core.snapshot import unpack
from agent.core.stream import DeviceStream
from agent.core.windows import margin_of
from agent.recording.in_order import OrderError, of_one_gateway
from agent.recording.reading import RecordingReader
from agent.recording.records import FileFault
from agent.report.trace import Trace
from calib.excitation.front_end import Settings, aligned, most_margin_s
from calib.model import Pose
from hw.block import SampleBlock

SHOWN = Settings(leave_out=False)  # knocks are shown
MOST_TRACES = 24  # windows kept point by point: the newest window of each of so many positions


@dataclass(slots=True)
class RecordedSensor:
    """The content of recordings for one sensor; `traces` by position, the newest last.

    `reference`: its name, None where there is none. `reference_quantity`: what the reference gives; None where there is
    no reference, or where nothing tells it.
    """

    sensor: str
    reference: str | None = None
    reference_quantity: str | None = None
    calibrations: list[CalibrationUpdate] = field(default_factory=list)
    windows: list[WindowReport] = field(default_factory=list)
    status: StatusChange | None = None
    traces: dict[str, Trace] = field(default_factory=dict)
    starts: list[RunStart] = field(default_factory=list)
    devices: dict[str, str] = field(default_factory=dict)  # DeviceInfo as JSON, by name
    faults: list[tuple[Path, FileFault]] = field(default_factory=list)


class RecordingError(Exception):
    """The recording cannot be used. The message names the file and the reason."""


def sensors_of(path: Path) -> list[str]:
    """Names of the sensors whose channels a recording holds. Raises RecordingError."""
    return [channel.sensor for channel in _config(path).channels]


def in_order_of(paths: Sequence[Path]) -> list[Path]:
    """Recordings of one gateway, the oldest first. Raises RecordingError."""
    try:
        return of_one_gateway([(path, _start(path)) for path in paths])
    except OrderError as error:
        raise RecordingError(str(error)) from None
    except OSError as error:
        raise RecordingError(f"{error.filename}: {error.strerror}") from None


def read_recordings(paths: list[Path], sensor: str) -> RecordedSensor:
    """Read files in the given order, each by itself. Raises RecordingError if one is damaged or cannot be read."""
    out = RecordedSensor(sensor)
    for path in paths:
        channel = next((c for c in _config(path).channels if c.sensor == sensor), None)
        if channel is None:
            raise RecordingError(f"{path}: the recording has no channel with the sensor {sensor!r}")
        out.reference = channel.reference
        out.reference_quantity = channel.instrument.quantity if channel.reference is not None else None
        reader = RecordingReader(path)
        windows: _WindowStreams | None = None
        for step in reader.steps():
            with _followed(path):
                if isinstance(step.event, RunStart):
                    out.starts.append(step.event)
                    windows = _WindowStreams(channel, step.event)
                assert windows is not None  # a recording with any step begins with RunStart
                windows.update(step.event)
                _take(out, step.event, step.results, windows)
        if reader.fault is not None:
            if reader.fault.kind == "corrupt":
                raise RecordingError(f"{path}: the recording is damaged at {reader.fault}; see `fieldcal audit`")
            out.faults.append((path, reader.fault))
    return out


@contextmanager
def _followed(path: Path) -> Iterator[None]:
    """Raises RecordingError where the streams cannot follow the recording from its snapshot."""
    try:
        yield
    except Exception as error:  # a damaged or forged snapshot may raise any exception
        raise RecordingError(
            f"{path}: its samples cannot be followed from its snapshot: {type(error).__name__}: {error!s:.200}; "
            "see `fieldcal audit`"
        ) from None


def _take(out: RecordedSensor, event: Event, results: list[Output], windows: _WindowStreams) -> None:
    if isinstance(event, DeviceChange) and event.info_json:
        out.devices[event.device] = event.info_json
    for result in results:
        if result.sensor != out.sensor:
            continue
        if isinstance(result, CalibrationUpdate):
            out.calibrations.append(result)
        elif isinstance(result, StatusChange):
            out.status = result
        elif isinstance(result, WindowReport):
            out.windows.append(result)
            trace = windows.trace(result) if result.used else None
            if trace is not None:
                out.traces.pop(result.position, None)
                out.traces[result.position] = trace
                if len(out.traces) > MOST_TRACES:
                    del out.traces[next(iter(out.traces))]


def _start(path: Path) -> RunStart:
    try:
        reader = RecordingReader(path)
        step = next(reader.steps(), None)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None
    if step is None or not isinstance(step.event, RunStart):
        raise RecordingError(f"{path}: {reader.fault or 'the file is not a recording of fieldcal'}")
    return step.event


def _config(path: Path) -> Config:
    try:
        return recorded_config(_start(path).config_json)
    except ValueError as error:
        raise RecordingError(f"{path}: its configuration cannot be read: {error}") from None


class _WindowStreams:
    """The streams of a channel as they were when the pipeline judged a window."""

    def __init__(self, channel: Channel, start: RunStart) -> None:
        held = unpack(start.snapshot)["channels"][channel.sensor]
        self._filters = DriverFilters(channel)
        self._filters.load(held["filters"])
        self._streams = {n: DeviceStream.restore(n, held["origin_ns"], s) for n, s in held["streams"].items()}

    @property
    def _channel(self) -> Channel:
        return self._filters.channel

    def update(self, event: Event) -> None:
        if isinstance(event, DeviceChange) and event.info_json:
            self._filters.hear(event.device, json.loads(event.info_json))
        if isinstance(event, SampleBlock) and event.device in self._streams:
            stream = self._streams[event.device]
            stream.update(event)
            channel = self._channel
            keep_s = channel.window_s + channel.late_horizon_s + 2 * most_margin_s(channel.instrument)
            stream.forget_before((stream.newest_arrival_s or 0.0) - keep_s)

    def trace(self, window: WindowReport) -> Trace | None:
        """The points of a window; None if its pose or its samples cannot be found."""
        place = int(window.numbers.get("check_reference", 0.0))
        channel = self._channel.by_reference[place]
        first_s = self._streams[channel.sensor].first_sample_s
        pose = _pose(channel, window)
        if first_s is None or pose is None:
            return None
        start_s, stop_s = first_s + window.start_s, first_s + window.stop_s
        cut = self._streams[channel.sensor].cut(start_s, stop_s)
        if cut is None:
            return None
        if channel.reference is None:
            whole = np.isfinite(cut.values).all(axis=1)
            nothing = np.empty((int(whole.sum()), 0))
            return Trace(cut.time_s[whole] - first_s, cut.values[whole], nothing, nothing, pose)
        around_s = margin_of(channel, self._streams)
        reference = self._streams[channel.reference].cut(start_s - around_s, stop_s + around_s)
        lag_s = window.numbers.get("lag_applied_s", 0.0)
        instrument, span_s = channel.instrument, (start_s, stop_s)
        found = None if reference is None else aligned(cut, reference, instrument, span_s, lag_s, SHOWN)
        if found is None:
            return None
        points = found.points
        return Trace(points.time_s - first_s, points.V, points.u, points.du, pose)


def _pose(channel: Channel, window: WindowReport) -> Pose | None:
    """The pose of the sensor in the middle of the window."""
    middle_s = 0.5 * (window.start_s + window.stop_s)
    schedule: Iterator[Pose] = (
        piece.pose
        for piece in itertools.takewhile(lambda p: p.start_s <= middle_s, pieces(channel, 0.0))
        if middle_s <= piece.stop_s
    )
    return next(schedule, None)
