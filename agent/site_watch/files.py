"""Reads hourly `watch` results from files of JSON lines and from recordings, in any order, and gives them day by day.

JSON lines are read twice: once to check each and to note where the hours of each day stand, and once day by day. So a
year of many sensors needs little memory, and the lines need not be sorted. Of recordings the hours are kept. A result
that cannot be used is counted by its reason, never fatal; the first one of each reason is told with its place.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from io import BufferedReader
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from agent.config.files import open_file
from agent.core.events import CalibrationUpdate, Result, RunStart, SelfTestReport, WatchReport
from agent.recording.reading import RecordingReader
from agent.site_watch.day_sum import DaySum, Made, summed
from agent.site_watch.hour import TWICE, CalibrationLine, SelfTestLine, WatchHour, grid, wrong
from agent.site_watch.source import SiteSource, WatchError
from calib.model import Array

LONGEST_LINE = 1 << 20  # bytes
MOST_SENSORS = 4000
RECORDING = b"\x89MCAP0\r\n"  # how a recording begins

Kind = TypeVar("Kind", bound=msgspec.Struct)
Place = tuple[int, int]  # file and offset of a line
_HOUR = msgspec.msgpack.Decoder(WatchHour)


class _Files:
    """What has been read of the files."""

    def __init__(self) -> None:
        self.numbers: dict[tuple[str, str], int] = {}
        self.bands: set[int] = set()
        self.site = ""  # that of the first line that names one
        self.lines = 0
        self.left_out: Counter[str] = Counter()
        self.first: dict[str, str] = {}
        self.hours: dict[int, dict[tuple[int, int], tuple[int, Place | bytes]]] = {}  # by day, sensor and hour
        self.mains: dict[tuple[int, Made], Array] = {}
        self.self_tests: dict[int, dict[int, SelfTestLine]] = {}  # by day and sensor

    def leave_out(self, reason: str, place: str) -> None:
        self.left_out[reason] += 1
        self.first.setdefault(reason, place)

    def take(self, hour: WatchHour, site: str, gateway: str, at: Place | bytes) -> str:
        """Note an hour. Returns why it is left out; "" where it is used."""
        if reason := wrong(hour):
            return reason
        self.site = self.site or site
        if site and self.site != site:
            return "of another site than the first line that names one; give the files of one site"
        i = self.number(gateway, hour.sensor)
        if i is None:
            return f"more than {MOST_SENSORS} sensors"
        day = self.hours.setdefault(hour.day, {})
        before = day.get((i, hour.hour))
        if before is None or before[0] <= hour.sequence:
            day[i, hour.hour] = hour.sequence, at
            self.bands.update(grid(hour.band_hz))
        return "" if before is None else TWICE

    def calibrated(self, line: CalibrationLine, gateway: str) -> None:
        """Note the main sensitivities of a calibration."""
        if (i := self.number(gateway, line.sensor)) is not None:
            self.mains[i, line.made] = line.main

    def tested(self, line: SelfTestLine, gateway: str) -> None:
        """Note a self-test; of two of a day that with the higher sequence."""
        if (i := self.number(gateway, line.sensor)) is not None:
            day = self.self_tests.setdefault(line.day, {})
            if i not in day or day[i].sequence <= line.sequence:
                day[i] = line

    def number(self, gateway: str, sensor: str) -> int | None:
        """The number of a sensor; None where there are too many."""
        who = gateway, sensor
        if who not in self.numbers and len(self.numbers) >= MOST_SENSORS:
            return None
        return self.numbers.setdefault(who, len(self.numbers))


def from_files(paths: Sequence[Path]) -> SiteSource:
    """Check all results of the files. Raises OSError, or WatchError where none can be used."""
    found = _Files()
    for k, path in enumerate(paths):
        with open_file(path) as file:
            begin = file.read(len(RECORDING))
            file.seek(0)
            if begin != RECORDING:
                _read_lines(found, k, path, file)
        if begin == RECORDING:
            _read_recording(found, path)
    if not found.hours:
        told = "; ".join(f"{reason}, first at {found.first[reason]}" for reason in found.left_out)
        raise WatchError(f"no line is an hourly result of a sensor ({told or 'the files are empty'})")
    used = sorted({i for day in found.hours.values() for i, _ in day})
    names = list(found.numbers)
    return SiteSource([names[i] for i in used], used, sorted(found.bands), lambda: _sums(found, paths),
                      found.lines, found.left_out, found.first)  # fmt: skip


def _read_lines(found: _Files, k: int, path: Path, file: BufferedReader) -> None:
    offset, number = 0, 0
    while data := file.readline(LONGEST_LINE):
        number += 1
        if data.strip():
            reason = _line(found, (k, offset), data, path.stem)
            if reason:
                found.leave_out(reason, f"{path}:{number}")
        offset += len(data)


def _line(found: _Files, at: Place, data: bytes, stem: str) -> str:
    """Take a line. Returns why it is left out."""
    found.lines += 1
    if len(data) >= LONGEST_LINE:
        return f"a line of more than {LONGEST_LINE} bytes"
    try:
        line = msgspec.json.decode(data, type=WatchHour)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        if (made := _decoded(data, CalibrationLine)) is not None:
            found.calibrated(made, made.gateway or _named(made.key)[1] or stem)
        elif (test := _decoded(data, SelfTestLine)) is not None:
            found.tested(test, test.gateway or _named(test.key)[1] or stem)
        else:
            return f"not a watch result: {_short(str(error))}"
        found.lines -= 1
        return ""
    site, gateway = _named(line.key)
    return found.take(line, line.site or site, line.gateway or gateway or stem, at)


def _decoded(data: bytes, kind: type[Kind]) -> Kind | None:
    """A line as a result of this kind; None where it is none."""
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def _named(key: str) -> tuple[str, str]:
    """Site and gateway in a key on the bus; "" where it has none."""
    parts = key.split("/")
    return (parts[2], parts[3]) if len(parts) == 6 and parts[:2] == ["fieldcal", "v1"] else ("", "")


def _read_recording(found: _Files, path: Path) -> None:
    """Take the results of a recording, as far as it can be read."""
    reader, site, gateway = RecordingReader(path), "", path.stem
    for step in reader.steps():
        if isinstance(step.event, RunStart):
            site, gateway = step.event.site, step.event.gateway or gateway
        for result in step.results:
            if isinstance(result, WatchReport):
                found.lines += 1
                hour = WatchHour(**_as_json(result, WatchHour))
                if reason := found.take(hour, site, gateway, msgspec.msgpack.encode(hour)):
                    found.leave_out(reason, f"{path}: result {result.sequence}")
            elif isinstance(result, SelfTestReport):
                found.tested(SelfTestLine(**_as_json(result, SelfTestLine)), gateway)
            elif isinstance(result, CalibrationUpdate):
                line = CalibrationLine(sensor=result.sensor, sensitivity=_without_nan(result.sensitivity),
                                       run_id=result.made[0], sequence=result.made[1])  # fmt: skip
                found.calibrated(line, gateway)
    if reader.fault is not None:
        found.leave_out(
            "the recording ends early, or is damaged; what stands before is used", f"{path}: {reader.fault}"
        )


def _as_json(report: Result, kind: type[msgspec.Struct]) -> dict[str, Any]:
    """The fields that are used; None for NaN."""
    told = msgspec.structs.asdict(report)
    return {name: _without_nan(told[name]) for name in kind.__struct_fields__ if name in told}


def _without_nan(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_nan(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _sums(found: _Files, paths: Sequence[Path]) -> Iterator[DaySum]:
    with ExitStack() as stack:
        opened = [stack.enter_context(open_file(path)) for path in paths]
        for number in sorted(found.hours):
            rows = ((i, _read(opened, at)) for (i, _), (_, at) in found.hours[number].items())
            yield summed(number, rows, found.mains, found.self_tests.get(number, {}))


def _read(opened: Sequence[BufferedReader], at: Place | bytes) -> WatchHour:
    if isinstance(at, bytes):
        return _HOUR.decode(at)
    opened[at[0]].seek(at[1])
    return msgspec.json.decode(opened[at[0]].readline(LONGEST_LINE), type=WatchHour)


def _short(text: str) -> str:
    return text if len(text) <= 120 else f"{text[:120]}…"
