"""MiniSEED by ObsPy: the traces of a station, as counts, each sample at the time that its record states."""

from __future__ import annotations

import itertools
import math
import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from agent.config.files import open_file
from agent.reading.seed_records import SeedRecord, records
from agent.reading.source import Array, Arrays, Column, Grid, Stretches, TableError, check_announced
from agent.reading.stationxml import import_obspy
from calib.model import Slices

# The last letter of a channel's code names its component: east, north and up are x, y and z.
AXES = {"E": "x", "N": "y", "Z": "z"}
LARGEST = 1 << 30  # bytes of a file, all of which are in memory while it is read
LONGEST_HOLE_S = 10.0  # a longer one is left to the times
SAME_RATE = 0.01  # relative: times of records that tell another rate by more have gaps
FEWEST_RECORDS = 8  # from which their times tell the rate
FINEST_S, OFF_GRID = 1e-4, 0.05  # resolution of a time without microseconds; periods that a record may be off the grid


class MiniSeed(Arrays):
    """A MiniSEED file. `seed_ids`: the channel of each column of samples; `values`: of each column."""

    def __init__(
        self, path: Path, values: Mapping[Column, Slices], seed_ids: Mapping[Column, str], said: Sequence[str] = ()
    ) -> None:
        super().__init__(path, values)
        self.values, self.seed_ids, self.said = values, seed_ids, said


@dataclass(frozen=True, slots=True)
class GridRun:
    """Samples of a channel that follow each other on one grid: the time of the first, in s since 1970, and how many."""

    start_s: float
    samples: int


@dataclass(frozen=True, slots=True)
class SeismicTrace:
    """A channel with its samples (n,), and the runs of which they consist, at the rate that their times tell."""

    seed_id: str
    stated_hz: float
    rate_hz: float
    data: Array
    runs: list[GridRun]


def open_miniseed(path: Path) -> MiniSeed:
    """Each sensor of a station is a group with `time_s` and its components.

    The group is named network.station.location.channel, without the last letter of the channel. A component that is
    missing for a time has gaps there; where all are missing, the times jump. The file is read from its bytes: ObsPy
    takes a name for a pattern of names or an address, and unpacks what it takes for an archive. Raises TableError.
    """
    obspy = import_obspy()
    data, said = _bytes(path), list[str]()
    found, whole = _whole_records(path, data, said)
    check_announced(path, sum(8 * record.samples for record in found))
    with warnings.catch_warnings(), _quiet_callbacks():
        warnings.simplefilter("ignore")
        try:
            stream = obspy.read(BytesIO(whole), format="MSEED", check_compression=False)
        except Exception as error:  # ObsPy raises many kinds for broken files
            reason = " ".join(str(error).split())
            raise TableError(f"{path}: the file cannot be read: {reason}; write it anew") from None
    groups: dict[str, list[SeismicTrace]] = {}
    for component in _components(path, stream, found):
        groups.setdefault(component.seed_id[:-1], []).append(component)
    values: dict[Column, Slices] = {}
    seed_ids: dict[Column, str] = {}
    for group, components in groups.items():
        times, rows = _rows(path, group, components, said)
        values[Column("time_s", "s", group)] = times
        for component, samples in zip(components, rows, strict=True):
            code = component.seed_id.rpartition(".")[2][-1:]
            column = Column(AXES.get(code, code or "a"), "counts", group)
            values[column], seed_ids[column] = samples, component.seed_id
    if not values:
        raise TableError(f"{path}: no channel has numbers; give the file with the channels of the sensor")
    return MiniSeed(path, values, seed_ids, said)


def _bytes(path: Path) -> bytes:
    """The file. Raises TableError where it is too large to be read at once."""
    try:
        with open_file(path) as file:
            if os.fstat(file.fileno()).st_size <= LARGEST:
                return file.read(LARGEST)
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from None
    raise TableError(f"{path}: the file has more than {LARGEST} bytes, so it is not read; split it by time")


def _whole_records(path: Path, data: bytes, said: list[str]) -> tuple[list[SeedRecord], bytes]:
    """The records of the file by channel and time, and their bytes; all of the file where no record is found in it.

    `said` gets what is left out: a record that is cut, what is no record, and records that are there twice.
    """
    found, stop = list(records(data)), len(data)
    if found and found[-1].at + found[-1].length > stop:
        stop = found.pop().at
        said.append(
            f"{path}: the file ends early, as after a power cut; it is read up to byte {stop} of {len(data)} (the "
            "record there is cut)"
        )
    if not found:
        return [], data
    between = stop - sum(record.length for record in found)
    if between and data[6:7] in b"DRQM":  # a full SEED volume begins with headers of other kinds
        said.append(f"{path}: {between} bytes are no records of MiniSEED; they are left out")
    taken: dict[tuple[str, int, bytes], SeedRecord] = {}
    for record in found:
        taken.setdefault((record.seed_id, record.start_ns, data[record.at + 8 : record.at + record.length]), record)
    if len(taken) < len(found):
        said.append(f"{path}: {len(found) - len(taken)} records are there twice; each is taken once")
    whole = sorted(taken.values(), key=lambda record: (record.seed_id, record.start_ns, record.at))
    return whole, b"".join(data[record.at : record.at + record.length] for record in whole)


def _components(path: Path, stream: Any, found: Sequence[SeedRecord]) -> Iterator[SeismicTrace]:
    """Yield the channels of numbers. Raises TableError where one has several rates."""
    told: dict[str, list[SeedRecord]] = {}
    for record in found:
        if record.samples:
            told.setdefault(record.seed_id, []).append(record)
    by_id: dict[str, list[Any]] = {}
    for trace in stream:
        if trace.data.dtype.kind in "iuf":
            by_id.setdefault(trace.id, []).append(trace)
    for seed_id, traces in by_id.items():
        rates = {float(trace.stats.sampling_rate) for trace in traces}
        if len(rates) > 1 or not min(rates) > 0.0:
            raise TableError(f"{path}, {seed_id}: the samples have the rates {sorted(rates)} Hz; split the file")
        stated_hz = rates.pop()
        parts = [(record.start_ns, record.samples) for record in told.get(seed_id, ())]
        if not _agree(parts, traces):
            parts = [(trace.stats.starttime.ns, len(trace.data)) for trace in traces]
        made = [(rate_hz, _runs(parts, rate_hz)) for rate_hz in (stated_hz, _rate(parts, stated_hz))]
        rate_hz, runs = min(made, key=lambda each: len(each[1]))
        yield SeismicTrace(seed_id, stated_hz, rate_hz, np.concatenate([trace.data for trace in traces]), runs)


def _agree(parts: Sequence[tuple[int, int]], traces: Sequence[Any]) -> bool:
    """Whether the traces consist of the records (start in ns, samples) in their order."""
    starts, first = dict[int, int](), 0
    for start_ns, samples in parts:
        starts[first] = start_ns
        first += samples
    at = np.cumsum([0, *(len(trace.data) for trace in traces)]).tolist()
    return at[-1] == first and all(
        abs(starts.get(k, 0) - trace.stats.starttime.ns) < 1e9 * FINEST_S
        for k, trace in zip(at[:-1], traces, strict=True)
    )


def _rate(parts: Sequence[tuple[int, int]], stated_hz: float) -> float:
    """The rate that the times of the records tell: the stated one where they are few or tell another by far."""
    starts, samples = np.array(parts, dtype=np.int64).T
    steps_s = 1e-9 * np.diff(starts)
    if len(steps_s) < FEWEST_RECORDS or not steps_s.min() > 0.0:
        return stated_hz
    rate_hz = float(np.median(samples[:-1] / steps_s))
    return rate_hz if abs(rate_hz / stated_hz - 1.0) < SAME_RATE else stated_hz


def _off_grid_s(rate_hz: float) -> float:
    """By how much the time of a record may differ from the grid that it is on."""
    return min(max(OFF_GRID / rate_hz, FINEST_S), 0.5 / rate_hz)


def _runs(parts: Sequence[tuple[int, int]], rate_hz: float) -> list[GridRun]:
    """The records (start in ns, samples) joined where one follows the other on the grid of this rate."""
    off_s = _off_grid_s(rate_hz)
    runs: list[GridRun] = []
    first_ns, count = parts[0]
    for start_ns, samples in parts[1:]:
        if abs(1e-9 * (start_ns - first_ns) - count / rate_hz) > off_s:
            runs.append(GridRun(first_ns * 1e-9, count))
            first_ns, count = start_ns, 0
        count += samples
    return [*runs, GridRun(first_ns * 1e-9, count)]


def _rows(path: Path, group: str, components: Sequence[SeismicTrace], said: list[str]) -> tuple[Slices, list[Array]]:
    """The times of the rows of a group, and each component's samples in them, NaN where it has none."""
    rates = {component.stated_hz for component in components}
    if len(rates) > 1:
        raise TableError(f"{path}, {group}: the components have the rates {sorted(rates)} Hz; split the file")
    longest = max(components, key=lambda component: len(component.data))
    times = _times(longest, components)
    check_announced(path, 8 * len(times) * len(components))
    rows = []
    for component in components:
        whole, lost = _placed(component, times)
        if lost:
            told = f"{lost} samples are left out, since {longest.seed_id} has none at their times"
            said.append(f"{path}, {component.seed_id}: {told}")
        rows.append(whole)
    return (Grid(times.starts_s[0], longest.rate_hz, len(times)) if len(times.firsts) == 1 else times), rows


def _times(longest: SeismicTrace, components: Sequence[SeismicTrace]) -> Stretches:
    """The times of the rows: those of the longest component, and before and after it those of the others.

    A hole of up to LONGEST_HOLE_S has as many rows as samples are missing, a longer one has one.
    """
    rate_hz, runs = longest.rate_hz, longest.runs
    begin_s = min(component.runs[0].start_s for component in components)
    end_s = max(each.runs[-1].start_s + each.runs[-1].samples / each.rate_hz for each in components)
    at = max(0, round((runs[0].start_s - begin_s) * rate_hz))
    firsts, starts_s, periods_s = [0], [begin_s if at else runs[0].start_s], [1.0 / rate_hz]
    for run, following in itertools.pairwise(runs):
        missing = (following.start_s - run.start_s) * rate_hz - run.samples
        at += run.samples + (1 if missing >= LONGEST_HOLE_S * rate_hz else round(missing))
        if abs(following.start_s - starts_s[-1] - (at - firsts[-1]) / rate_hz) <= _off_grid_s(rate_hz):
            continue
        if abs(missing) < 0.5:
            periods_s[-1] = (following.start_s - starts_s[-1]) / (at - firsts[-1])
        firsts.append(at)
        starts_s.append(following.start_s)
        periods_s.append(1.0 / rate_hz)
    after = max(0, round((end_s - runs[-1].start_s) * rate_hz) - runs[-1].samples)
    return Stretches(rate_hz, at + runs[-1].samples + after, tuple(firsts), tuple(starts_s), tuple(periods_s))


def _placed(component: SeismicTrace, times: Stretches) -> tuple[Array, int]:
    """The samples in the rows of their times, and how many have no row. Where two differ in one row, none is taken."""
    whole = np.full(len(times), np.nan)
    data, lost = component.data, 0
    for run in component.runs:
        k = 0
        while k < run.samples:
            row, stop, next_s = times.place(run.start_s + k / component.rate_hz)
            n = min(run.samples - k, stop - row)
            if n > 0:
                there, new = whole[row : row + n], np.asarray(data[k : k + n], np.float64)
                whole[row : row + n] = np.where(np.isfinite(there) & (there != new), np.nan, new)
            else:
                n = min(run.samples - k, max(1, math.ceil((next_s - run.start_s) * component.rate_hz - 0.5) - k))
                lost += n
            k += n
        data = data[run.samples :]
    return whole, lost


@contextmanager
def _quiet_callbacks() -> Iterator[None]:
    """Where a damaged header is no text, a callback of ObsPy fails, and Python would print that with its traceback."""
    before, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        yield
    finally:
        sys.unraisablehook = before
