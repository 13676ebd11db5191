"""Samples of recordings with the times of the clock model, and the accelerations that the newest calibration gives."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from agent.config import recorded_config
from agent.core.events import CalibrationUpdate, DeviceChange, RunStart
from agent.core.kept import update_of
from agent.core.snapshot import unpack
from agent.core.stream import UNCOUNTED, DeviceStream
from agent.recording.reading import RecordingReader, Step, first_event
from calib.model import Array
from hw.block import SampleBlock

DELAY_S = 20.0  # a block waits so long, because later bursts make its clock better


class ExportError(Exception):
    """The recordings cannot be exported. The message names the file, the reason and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Consecutive samples of one device: `t_utc_ns` (n,) by its clock, `values` (n, axes) in `unit`.

    `acceleration` (n, 3) in m/s2, None without a calibration. `first_index`: number of the first sample in the device's
    own count. `rate_hz`: of the clock.
    """

    t_utc_ns: NDArray[np.int64]
    values: Array
    acceleration: Array | None
    first_index: int
    rate_hz: float
    temperature_degc: float | None


@dataclass(slots=True)
class Content:
    """What recordings have of one device: `calibrations` in order of time, the first may be older than the files."""

    device: str
    unit: str = "count"
    axes: int = 0
    calibrations: list[CalibrationUpdate] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write, which must not exist. It is removed again where writing fails. Raises OSError."""
    with path.open("xb") as file:
        try:
            yield file
        except BaseException:
            path.unlink(missing_ok=True)
            raise


@contextmanager
def _followed(path: Path) -> Iterator[None]:
    """Raises ExportError where the samples cannot follow the recording from its snapshot."""
    try:
        yield
    except ExportError:
        raise
    except Exception as error:  # a damaged or forged snapshot may raise any exception
        raise ExportError(
            f"{path}: its samples cannot be followed from its snapshot: {type(error).__name__}: {error!s:.200}; "
            f"`fieldcal audit {path}` says more"
        ) from None


def content_of(paths: Sequence[Path], device: str | None) -> Content:
    """Look through the recordings for the device; without a name, for the only sensor. Raises ExportError."""
    names = list(dict.fromkeys(sensor for path in paths for sensor in sensors_of(path)))
    if device is None and len(names) != 1:
        raise ExportError(f"{paths[0]}: has the sensors {', '.join(names)}; choose one with --device")
    found = Content(device or names[0])
    for path in paths:
        with _followed(path):
            for step in _steps(path, found.faults):
                _look(step, found)
    if not found.axes:
        raise ExportError(f"{paths[0]}: has no samples of {found.device!r}; its sensors are {', '.join(names)}")
    return found


def samples(paths: Sequence[Path], content: Content) -> Iterator[Samples]:
    """The samples of the device in order. A block whose samples get no time from the clock is left out."""
    for path in paths:
        start = _start(path)
        with _followed(path):
            clocked = _Clocked(start, content)
            for step in _steps(path, []):
                if isinstance(step.event, SampleBlock) and step.event.device == content.device and step.event.n:
                    yield from clocked.update(step.event)
            yield from clocked.rest()


def acceleration(values: Array, calibration: CalibrationUpdate, degc: float | None) -> Array | None:
    """a = S^-1 (V - Q) in m/s2 at this temperature, which is only known where the device tells it; None: no inverse."""
    S, Q = np.array(calibration.sensitivity), np.array(calibration.offset)
    if degc is not None and np.isfinite(calibration.reference_temperature_degc):
        above = degc - calibration.reference_temperature_degc
        for k, coefficient in enumerate(calibration.offset_temperature, start=1):
            Q = Q + np.array(coefficient) * above**k
        if calibration.sensitivity_temperature:
            S = S * (1.0 + np.array(calibration.sensitivity_temperature) * above)[:, None]
    try:
        return np.asarray(np.linalg.solve(S, (values - Q).T).T)
    except np.linalg.LinAlgError:
        return None


class _Clocked:
    """The clock of one device in one file, and the blocks that wait for it."""

    def __init__(self, start: RunStart, content: Content) -> None:
        self._content = content
        self._waiting: deque[SampleBlock] = deque()
        self._stream, origin_ns = _stream(start, content.device)
        self._origin_utc_ns = start.t_utc_ns - start.t_monotonic_ns + origin_ns

    def update(self, block: SampleBlock) -> Iterator[Samples]:
        """Take the next block; yield those that have waited long enough."""
        if block.flags & UNCOUNTED:
            yield from self.rest()
        self._stream.update(block)
        self._waiting.append(block)
        newest_ns = block.t_monotonic_ns
        while newest_ns - self._waiting[0].t_monotonic_ns > DELAY_S * 1e9:
            yield from self._timed(self._waiting.popleft())
        newest_s = self._stream.newest_arrival_s
        if newest_s is not None:
            self._stream.forget_before(newest_s - DELAY_S)

    def rest(self) -> Iterator[Samples]:
        """Yield all that still wait."""
        while self._waiting:
            yield from self._timed(self._waiting.popleft())

    def _timed(self, block: SampleBlock) -> Iterator[Samples]:
        told = self._stream.clock()
        if told is None:
            return
        clock = told[0]
        if not 0.0 < clock.rate_hz < np.inf:
            raise ExportError(
                f"{self._content.device}: the times of its samples do not rise (rate {clock.rate_hz:.3g} Hz), so that "
                "they cannot be exported; `fieldcal audit` says whether the recording is damaged"
            )
        times_s = clock.time_of(block.first_index + np.arange(block.n))
        values = np.asarray(block.indications, dtype=np.float64)
        newest = self._content.calibrations[-1] if self._content.calibrations else None
        degc = block.temperature_degc
        a = None if newest is None or values.shape[1] != 3 else acceleration(values, newest, degc)
        t_utc_ns = self._origin_utc_ns + np.round(times_s * 1e9).astype(np.int64)
        yield Samples(t_utc_ns, values, a, block.first_index, clock.rate_hz, degc)


def _stream(start: RunStart, device: str) -> tuple[DeviceStream, int]:
    """The stream of the device as it was when the file began, and the origin of its times in ns."""
    channels = unpack(start.snapshot)["channels"].values()
    for channel in channels:
        if device in channel["streams"]:
            origin_ns = channel["origin_ns"]
            return DeviceStream.restore(device, origin_ns, channel["streams"][device]), origin_ns
    return DeviceStream(device, start.t_monotonic_ns), start.t_monotonic_ns


def _look(step: Step, found: Content) -> None:
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


def _steps(path: Path, faults: list[str]) -> Iterator[Step]:
    """Yield the steps of a file; why it ends early is added to `faults`. Raises ExportError for a damaged one."""
    reader = RecordingReader(path)
    try:
        yield from reader.steps()
    except OSError as error:
        raise ExportError(f"{path}: {error.strerror or error}") from None
    if reader.fault is not None:
        if reader.fault.kind == "corrupt":
            raise ExportError(f"{path}: damaged at {reader.fault}; `fieldcal audit {path}` says more")
        faults.append(f"{path}: ends early, at {reader.fault}; the samples before this place are exported")


def sensors_of(path: Path) -> list[str]:
    """The sensors of a recording's configuration. Raises ExportError."""
    try:
        return [channel.sensor for channel in recorded_config(_start(path).config_json).channels]
    except ValueError as error:
        raise ExportError(f"{path}: its configuration cannot be read: {error}") from None


def _start(path: Path) -> RunStart:
    try:
        start = first_event(path)
    except OSError as error:
        raise ExportError(f"{path}: {error.strerror or error}") from None
    if start is None:
        raise ExportError(f"{path}: the file is not a recording of fieldcal; `fieldcal convert` reads other files")
    return start
