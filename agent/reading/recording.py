"""Recordings of this program (MCAP): the raw samples of its devices, read block by block."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agent.config.filters import FiltersError, filters_of
from agent.core.events import DeviceChange, RunStart
from agent.reading.source import Array, Column, Progress, Source, TableError
from agent.recording.reading import RecordingReader, first_event
from hw.block import BlockFlags, SampleBlock

AXES = {1: ("a",), 3: ("x", "y", "z")}
QUANTITIES = {"m/s2": "a", "m/s": "v", "m": "d"}  # name of the channel of a uniaxial device, by its unit
LONGEST_HOLE_S = 10.0  # a longer one is left to the time stamps
HOLES_MAX = 1_000_000  # rows of all holes; more only up to ten times the samples before, the rest is left to the stamps


class RecordingSource(Source):
    """A recording. Each device is a group with `time_s`, its axes and, where it has one, `temperature_degc`.

    The time is the arrival of the burst to which a sample belongs, in s since 1970. Lost samples that the device
    counted are rows of NaN. A file that ends early is read to there, and `said` says it. Raises TableError for a
    damaged one.
    """

    header = "devices"

    def __init__(self, path: Path, start: RunStart) -> None:
        self.path = path
        self._utc_ns = start.t_utc_ns - start.t_monotonic_ns
        if abs(self._utc_ns) >= 1 << 63:
            raise self._fault(f"it begins {start.t_utc_ns} ns after 1970, {start.t_monotonic_ns} ns after a boot")
        devices = self._description(start.config_json, "devices")
        units: dict[str, str] = {}
        filters: dict[str, tuple[str, ...]] = {}
        columns: dict[str, list[Column]] = {}
        for event in self._events():
            if isinstance(event, DeviceChange) and event.info_json:
                units[event.device] = str(self._description(event.info_json, "unit"))
                filters[event.device] = self._filters(event)
            if isinstance(event, SampleBlock) and event.device not in columns:
                columns[event.device] = _columns(event, units.get(event.device, "count"))
                if isinstance(devices, list) and len(columns) == len(devices):
                    break
        if self.said and not columns:
            raise TableError(f"{self.said[0]}; no sample is before that")
        self.columns = [column for name in sorted(columns) for column in columns[name]]
        self.filters = filters

    def _description(self, text: str, name: str) -> Any:
        """What the configuration or the description of a device says. Raises TableError."""
        try:
            return json.loads(text)[name]
        except (ValueError, KeyError, TypeError, IndexError, RecursionError):
            raise self._fault(f"what it says of its devices has no {name!r}") from None

    def _filters(self, opened: DeviceChange) -> tuple[str, ...]:
        """What the driver of a device states of its filters; none in recordings of earlier versions."""
        try:
            return filters_of(json.loads(opened.info_json).get("filters", ()))
        except FiltersError as error:
            raise self._fault(f"the filters of {opened.device!r:.70} cannot be used: {error}") from None

    def _fault(self, what: str) -> TableError:
        return TableError(f"{self.path}: {what}; `fieldcal audit {self.path}` says more")

    def pieces(self, columns: Sequence[Column], progress: Progress | None) -> Iterator[Array]:
        """Yield the samples of one device. Raises TableError if the columns belong to several devices."""
        device = columns[0].group
        if any(column.group != device for column in columns):
            raise TableError(f"{self.path}: the columns belong to several devices; add group=NAME of one device")
        names = [column.name for column in columns]
        size, following, samples, rows = self.path.stat().st_size, None, 0, 0
        for event in self._events():
            if not isinstance(event, SampleBlock) or event.device != device:
                continue
            table = self._table(event, names)
            missing = 0 if following is None else event.first_index - following
            short = 0 < missing < LONGEST_HOLE_S * event.nominal_rate_hz and not event.flags & BlockFlags.RESTART
            if short and rows + missing <= max(HOLES_MAX, 10 * samples):
                rows += missing
                hole = np.full((missing, len(names)), np.nan)
                hole[:, names.index("time_s")] = table[0, names.index("time_s")]
                yield hole
            following = event.first_index + event.n
            samples += event.n
            yield table
        if progress is not None:
            progress(size)

    def _table(self, block: SampleBlock, names: Sequence[str]) -> Array:
        counts = np.diff(block.burst_count, prepend=0)
        arrivals = np.repeat((block.burst_t_monotonic_ns + self._utc_ns) * 1e-9, counts)
        given = {"time_s": arrivals, "temperature_degc": np.full(block.n, block.temperature_degc or np.nan)}
        axes = [name for name in names if name not in given]
        known = [c.name for c in self.columns if c.group == block.device and c.name not in given]
        if block.indications.shape[1] != len(known):
            raise self._fault(
                f"a block of {block.device!r:.70} has {block.indications.shape[1]} axes, not {len(known)}"
            )
        given |= {name: block.indications[:, known.index(name)].astype(np.float64) for name in axes}
        return np.column_stack([given[name] for name in names])

    def _events(self) -> Iterator[object]:
        reader = RecordingReader(self.path)
        for step in reader.steps():
            yield step.event
        if reader.fault is not None and reader.fault.kind == "corrupt":
            raise TableError(f"{self.path}, {reader.fault}; `fieldcal audit {self.path}` says more")
        self.said = end_of(reader)


def _columns(block: SampleBlock, unit: str) -> list[Column]:
    axes = AXES[block.indications.shape[1]]
    if len(axes) == 1:
        axes = (QUANTITIES.get(unit, "a"),)
    found = [Column("time_s", "s", block.device), *(Column(axis, unit, block.device) for axis in axes)]
    return [*found, Column("temperature_degc", "degC", block.device)] if block.temperature_degc is not None else found


def end_of(reader: RecordingReader) -> list[str]:
    """What the user should know of the end of a recording that was read: that it is missing."""
    if reader.fault is not None:
        return [
            f"{reader.path}: the file ends early, as after a power cut, or is still written; it is read up to byte "
            f"{reader.good_bytes} of {reader.path.stat().st_size} ({reader.fault.reason})"
        ]
    if reader.repaired:
        return [f"{reader.path}: a crash left the file open, and it was closed later; what came after is not in it"]
    return []


def open_mcap(path: Path) -> Source:
    """Open a recording of this program, or of ROS 2. Raises TableError."""
    start = first_event(path)
    if start is not None:
        return RecordingSource(path, start)
    from agent.reading.ros2 import RosBag

    return RosBag(path)
