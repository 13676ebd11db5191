"""Samples of recordings with the times of the clock model, and the accelerations that the newest calibration gives, or
S and Q smoothed over the past."""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.config import Channel, recorded_config
from agent.core.events import CalibrationUpdate, DeviceChange, RunStart, StatusChange
from agent.core.identity import device_of, identity_of
from agent.core.kept import update_of
from agent.core.snapshot import unpack
from agent.core.stream import UNCOUNTED, DeviceStream
from agent.export.between_visits import BetweenVisits, acceleration_of, at_temperature
from agent.export.smoothing import Smoothed
from agent.recording.reading import RecordedStep, RecordingReader, first_event
from agent.site_watch.suspicion import Suspicion
from calib.model import Array
from hw.block import SampleBlock

DELAY_S = 20.0  # a block waits so long, because later bursts make its clock better


class ExportError(Exception):
    """The recordings cannot be exported. The message names the file, the reason and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class ExportedSamples:
    """Consecutive samples of one device: `t_utc_ns` (n,) by its clock, `values` (n, axes) in `unit`.

    `acceleration` (n, 3) in m/s2, None without a calibration. `first_index`: number of the first sample in the device's
    own count. `rate_hz`: of the clock. `calibration`: number of the one that was in force then, by which it came into
    force first; 0 where none was.
    """

    t_utc_ns: NDArray[np.int64]
    values: Array
    acceleration: Array | None
    first_index: int
    rate_hz: float
    temperature_degc: float | None
    calibration: int = 0


@dataclass(slots=True)
class RecordedContent:
    """What recordings have of one device: `calibrations` in order of time, the first may be older than the files.

    `suspicion`: what is suspected of it by the other sensors of its site; U of the calibrations holds it. `smoothed`:
    the past by which its samples are corrected, if that was asked for. `left_out`: how many samples get no
    acceleration by it, by the reason.
    """

    device: str
    unit: str = "count"
    axes: int = 0
    calibrations: list[CalibrationUpdate] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    smoothed: Smoothed | BetweenVisits | None = None
    suspicion: Suspicion | None = None
    left_out: Counter[str] = field(default_factory=Counter)


def suspect(content: RecordedContent, suspicion: Suspicion | None) -> None:
    """Enlarge U of the calibrations after a suspected change."""
    content.suspicion = suspicion
    if suspicion is not None:
        content.calibrations = [suspicion.update(update) for update in content.calibrations]


@contextmanager
def followed(path: Path) -> Iterator[None]:
    """Raises ExportError where what is done within does not follow from the snapshot of the recording."""
    try:
        yield
    except ExportError:
        raise
    except Exception as error:  # a damaged or forged snapshot may raise any exception
        raise ExportError(
            f"{path}: its content does not follow from its snapshot: {type(error).__name__}: {error!s:.200}; "
            f"`fieldcal audit {path}` says more"
        ) from None


def content_of(paths: Sequence[Path], device: str | None) -> RecordedContent:
    """Look through the recordings for the device; without a name, for the only sensor. Raises ExportError."""
    names = list(dict.fromkeys(sensor for path in paths for sensor in sensors_of(path)))
    if device is None and len(names) != 1:
        raise ExportError(f"{paths[0]}: has the sensors {', '.join(names)}; choose one with --device")
    found = RecordedContent(device or names[0])
    for path in paths:
        with followed(path):
            for step in steps_of(path, found.faults):
                _look(step, found)
    if not found.axes:
        raise ExportError(f"{paths[0]}: has no samples of {found.device!r}; its sensors are {', '.join(names)}")
    return found


def samples(paths: Sequence[Path], content: RecordedContent) -> Iterator[ExportedSamples]:
    """The samples of the device in order. A block whose samples get no time from the clock is left out.

    Raises ExportError, also where S and Q smoothed over the past are asked for and correct no sample.
    """
    corrected = content.smoothed is None
    for path in paths:
        for block in _of_file(path, content):
            corrected |= block.acceleration is not None
            yield block
    if not corrected:
        raise ExportError(f"{content.device}: no sample can be corrected: {'; '.join(content.left_out)}")


def _of_file(path: Path, content: RecordedContent) -> Iterator[ExportedSamples]:
    start = start_of(path)
    with followed(path):
        clocked = _Clocked(start, content)
        for step in steps_of(path, []):
            yield from clocked.update(step)
        yield from clocked.rest()


def acceleration(values: Array, calibration: CalibrationUpdate, degc: float | None) -> Array | None:
    """a = S^-1 (V - Q) in m/s2 at this temperature, which is only known where the device tells it; None: no inverse."""
    return acceleration_of(*at_temperature(calibration, degc), values)


@dataclass(frozen=True, slots=True)
class _WaitingBlock:
    """A block that waits for its clock, with the device that sent it and the calibration that was in force then."""

    block: SampleBlock
    device: str
    calibration: int


class _Clocked:
    """The clock of one device in one file, and the blocks that wait for it."""

    def __init__(self, start: RunStart, content: RecordedContent) -> None:
        self._content = content
        self._waiting: deque[_WaitingBlock] = deque()
        self._stream, origin_ns = _stream(start, content.device)
        self._origin_utc_ns = start.t_utc_ns - start.t_monotonic_ns + origin_ns
        channel = unpack(start.snapshot)["channels"].get(content.device, {})
        in_force = update_of(channel.get("in_force"))
        self._identity, self._device = channel.get("identity", ""), channel.get("device", "")
        self._calibration = 0 if in_force is None else in_force.made[1]

    def update(self, step: RecordedStep) -> Iterator[ExportedSamples]:
        """Take the next event; yield the blocks that have waited long enough."""
        event, name = step.event, self._content.device
        if isinstance(event, DeviceChange) and event.device == name and event.info_json:
            identity, self._device = identity_of(event.info_json), device_of(json.loads(event.info_json))
            self._calibration = self._calibration if identity == self._identity else 0
            self._identity = identity
        if isinstance(event, SampleBlock) and event.device == name and event.n:
            yield from self._take(event)
        for result in step.results:
            if isinstance(result, CalibrationUpdate) and result.sensor == name:
                self._calibration = result.made[1]
            elif isinstance(result, StatusChange) and result.sensor == name and result.status == "UNCALIBRATED":
                self._calibration = 0

    def _take(self, block: SampleBlock) -> Iterator[ExportedSamples]:
        if block.flags & UNCOUNTED:
            yield from self.rest()
        self._stream.update(block)
        self._waiting.append(_WaitingBlock(block, self._device, self._calibration))
        newest_ns = block.t_monotonic_ns
        while newest_ns - self._waiting[0].block.t_monotonic_ns > DELAY_S * 1e9:
            yield from self._timed(self._waiting.popleft())
        newest_s = self._stream.newest_arrival_s
        if newest_s is not None:
            self._stream.forget_before(newest_s - DELAY_S)

    def rest(self) -> Iterator[ExportedSamples]:
        """Yield all that still wait."""
        while self._waiting:
            yield from self._timed(self._waiting.popleft())

    def _timed(self, waiting: _WaitingBlock) -> Iterator[ExportedSamples]:
        told, block, content = self._stream.clock(), waiting.block, self._content
        if told is None:
            return
        clock = told[0]
        if not 0.0 < clock.rate_hz < np.inf:
            raise ExportError(
                f"{content.device}: the times of its samples do not rise (rate {clock.rate_hz:.3g} Hz), so that "
                "they cannot be exported; `fieldcal audit` says whether the recording is damaged"
            )
        times_s = clock.time_of(block.first_index + np.arange(block.n))
        values = np.asarray(block.indications, dtype=np.float64)
        t_utc_ns, degc, a = self._origin_utc_ns + np.round(times_s * 1e9).astype(np.int64), block.temperature_degc, None
        if content.smoothed is not None:
            middle_ns = int(t_utc_ns[len(t_utc_ns) // 2])
            a, why = content.smoothed.acceleration(waiting.device, values, middle_ns, degc)
            if why:
                content.left_out[why] += block.n
        elif content.calibrations and values.shape[1] == 3:
            a = acceleration(values, content.calibrations[-1], degc)
        yield ExportedSamples(t_utc_ns, values, a, block.first_index, clock.rate_hz, degc, waiting.calibration)


def _stream(start: RunStart, device: str) -> tuple[DeviceStream, int]:
    """The stream of the device as it was when the file began, and the origin of its times in ns."""
    channels = unpack(start.snapshot)["channels"].values()
    for channel in channels:
        if device in channel["streams"]:
            origin_ns = channel["origin_ns"]
            return DeviceStream.restore(device, origin_ns, channel["streams"][device]), origin_ns
    return DeviceStream(device, start.t_monotonic_ns), start.t_monotonic_ns


def _look(step: RecordedStep, found: RecordedContent) -> None:
    event = step.event
    if isinstance(event, RunStart):
        held = unpack(event.snapshot)["channels"].get(found.device)
        earlier = None if held is None else update_of(held["in_force"])
        if earlier is not None and not found.calibrations:
            found.calibrations.append(earlier)
    elif isinstance(event, DeviceChange) and event.device == found.device and event.info_json:
        found.unit = json.loads(event.info_json)["unit"]
    elif isinstance(event, SampleBlock) and event.device == found.device:
        found.axes = event.indications.shape[1]
    found.calibrations += [r for r in step.results if isinstance(r, CalibrationUpdate) and r.sensor == found.device]


def steps_of(path: Path, faults: list[str]) -> Iterator[RecordedStep]:
    """Yield the steps of a file; why it ends early is added to `faults`. Raises ExportError for a damaged one."""
    reader = RecordingReader(path)
    try:
        yield from reader.steps()
    except OSError as error:
        raise ExportError(f"{path}: {error.strerror or error}") from None
    if reader.fault is not None:
        if reader.fault.kind == "corrupt":
            raise ExportError(f"{path}: damaged at {reader.fault}; `fieldcal audit {path}` says more")
        faults.append(f"{path}: ends early, at {reader.fault}; what stands before this place is used")


def sensors_of(path: Path) -> list[str]:
    """The sensors of a recording's configuration. Raises ExportError."""
    return [channel.sensor for channel in _channels(path)]


def channel_of(path: Path, sensor: str) -> Channel | None:
    """The channel of a sensor in a recording's configuration; None for another device. Raises ExportError."""
    return next((channel for channel in _channels(path) if channel.sensor == sensor), None)


def _channels(path: Path) -> Sequence[Channel]:
    try:
        return recorded_config(start_of(path).config_json).channels
    except ValueError as error:
        raise ExportError(f"{path}: its configuration cannot be read: {error}") from None


def start_of(path: Path) -> RunStart:
    """The first event of a recording. Raises ExportError."""
    try:
        start = first_event(path)
    except OSError as error:
        raise ExportError(f"{path}: {error.strerror or error}") from None
    if start is None:
        raise ExportError(f"{path}: the file is not a recording of fieldcal; `fieldcal convert` reads other files")
    return start
