"""MiniSEED by ObsPy: the traces of a station, as counts."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from agent.reading.source import Array, Arrays, Column, Grid, TableError, check_announced
from agent.reading.stationxml import import_obspy
from calib.model import Slices

# The last letter of a channel's code names its component: east, north and up are x, y and z.
AXES = {"E": "x", "N": "y", "Z": "z"}
MERGED_BYTES = 16  # of each sample, for the channel whose traces are merged


class MiniSeed(Arrays):
    """A MiniSEED file. `seed_ids`: the channel of each column of samples; `values`: of each column."""

    def __init__(self, path: Path, values: Mapping[Column, Slices], seed_ids: Mapping[Column, str]) -> None:
        super().__init__(path, values)
        self.values, self.seed_ids = values, seed_ids


def open_miniseed(path: Path) -> MiniSeed:
    """Each sensor of a station is a group with `time_s` and its components.

    The group is named network.station.location.channel, without the last letter of the channel. A component that is
    missing for a time has gaps there. Raises TableError.
    """
    obspy = import_obspy()
    with warnings.catch_warnings(), _quiet_callbacks():
        warnings.simplefilter("ignore")
        try:
            stream = obspy.read(str(path), format="MSEED")
            check_announced(path, _size_bytes(stream))
            stream.merge(method=0)
        except TableError:
            raise
        except Exception as error:  # ObsPy raises many kinds for broken files
            raise TableError(f"{path}: the file cannot be read: {error}; write it anew") from None
    values: dict[Column, Slices] = {}
    seed_ids: dict[Column, str] = {}
    groups: dict[str, list[Any]] = {}
    for trace in stream:
        groups.setdefault(trace.id[:-1], []).append(trace)
    for group, traces in groups.items():
        rates = {float(trace.stats.sampling_rate) for trace in traces}
        if len(rates) > 1 or not min(rates) > 0.0:
            raise TableError(f"{path}, {group}: the components have the rates {sorted(rates)} Hz; split the file")
        rate_hz = rates.pop()
        start = min(trace.stats.starttime for trace in traces)
        first = [round((trace.stats.starttime - start) * rate_hz) for trace in traces]
        length = max(at + len(trace.data) for at, trace in zip(first, traces, strict=True))
        values[Column("time_s", "s", group)] = Grid(start.ns * 1e-9, rate_hz, length)
        for at, trace in zip(first, traces, strict=True):
            code = trace.stats.channel[-1:]
            column = Column(AXES.get(code, code or "a"), "counts", group)
            values[column], seed_ids[column] = _whole(trace.data, at, length), trace.id
    return MiniSeed(path, values, seed_ids)


def _size_bytes(stream: Any) -> int:
    """Memory of the samples with those that their gaps have: the components of a group are of one length."""
    size = 0
    for group in {trace.id[:-1] for trace in stream}:
        stats = [trace.stats for trace in stream if trace.id[:-1] == group]
        span_s = max(one.endtime for one in stats) - min(one.starttime for one in stats)
        length = int(span_s * max(one.sampling_rate for one in stats)) + 1
        size += length * (8 * len({one.channel for one in stats}) + MERGED_BYTES)
    return size


@contextmanager
def _quiet_callbacks() -> Iterator[None]:
    """Where a damaged header is no text, a callback of ObsPy fails, and Python would print that with its traceback."""
    before, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        yield
    finally:
        sys.unraisablehook = before


def _whole(data: Array, first: int, length: int) -> Array:
    """The samples from sample `first` on, NaN where there are none."""
    whole = np.full(length, np.nan)
    whole[first : first + len(data)] = np.ma.filled(np.ma.asarray(data, dtype=np.float64), np.nan)
    return whole
