"""MiniSEED by ObsPy: the traces of a station, as counts."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from agent.reading.source import Array, Arrays, Column, Grid, Slices, TableError

# The last letter of a channel's code names its component: east, north and up are x, y and z.
AXES = {"E": "x", "N": "y", "Z": "z"}


def open_miniseed(path: Path) -> Arrays:
    """Each sensor of a station is a group with `time_s` and its components.

    The group is named network.station.location.channel, without the last letter of the channel. A component that is
    missing for a time has gaps there. Raises TableError.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ObsPy's own, about packages that it uses
        import obspy

        try:
            stream = obspy.read(str(path), format="MSEED")
            stream.merge(method=0)
        except Exception as error:  # ObsPy raises many kinds for broken files
            raise TableError(f"{path}: the file cannot be read: {error}; write it anew") from None
    values: dict[Column, Slices] = {}
    groups: dict[str, list[obspy.Trace]] = {}
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
            values[Column(AXES.get(code, code or "a"), "counts", group)] = _whole(trace.data, at, length)
    return Arrays(path, values)


def _whole(data: Array, first: int, length: int) -> Array:
    """The samples from sample `first` on, NaN where there are none."""
    whole = np.full(length, np.nan)
    whole[first : first + len(data)] = np.ma.filled(np.ma.asarray(data, dtype=np.float64), np.nan)
    return whole
