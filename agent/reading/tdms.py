"""LabVIEW TDMS by npTDMS: channels with their waveform times and units."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from agent.reading.source import Array, Arrays, Column, Grid, TableError
from calib.model import Slices


class TimeStamps:
    """A channel of time stamps, in s since 1970."""

    def __init__(self, channel: Any) -> None:
        self._channel = channel

    def __len__(self) -> int:
        return len(self._channel)

    def __getitem__(self, rows: slice, /) -> Array:
        return _seconds(self._channel[rows])


def open_tdms(path: Path) -> Arrays:
    """Channels of numbers as columns, `time_s` of a group from the waveform properties. Raises TableError."""
    from nptdms import TdmsFile

    logging.getLogger("nptdms.reader").setLevel(logging.ERROR)  # it would print a line of its own
    with ExitStack() as opened:
        stream = opened.enter_context(path.open("rb"))
        try:
            values = _columns(TdmsFile.open(stream))
        except Exception as error:  # npTDMS raises many kinds for broken files
            raise TableError(f"{path}: the file cannot be read: {error}; write it anew") from None
        source = Arrays(path, values, stream.close)
        opened.pop_all()
    return source


def _columns(file: Any) -> dict[Column, Slices]:
    values: dict[Column, Slices] = {}
    for group in file.groups():
        for channel in group.channels():
            kind = np.dtype(channel.dtype).kind
            if len(channel) and kind in "iuf":
                unit = str(channel.properties.get("unit_string", ""))
                values[Column(channel.name, unit, group.name)] = channel
                if "wf_increment" in channel.properties:
                    values.setdefault(Column("time_s", "s", group.name), _times(channel))
            elif len(channel) and kind == "M":
                values[Column(channel.name, "s", group.name)] = TimeStamps(channel)
    return values


def _times(channel: Any) -> Grid:
    told = channel.properties
    start = told.get("wf_start_time")
    begin_s = float(_seconds(np.array([start]))[0]) if isinstance(start, np.datetime64) else 0.0
    return Grid(begin_s + float(told.get("wf_start_offset", 0.0)), 1.0 / float(told["wf_increment"]), len(channel))


def _seconds(stamps: Any) -> Array:
    ns = np.asarray(stamps, "datetime64[ns]").astype(np.int64)
    return np.asarray(ns // 10**9 + (ns % 10**9) * 1e-9)
