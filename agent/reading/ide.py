"""enDAQ and Slam Stick recordings (IDE) by idelib, in a process of its own."""

from __future__ import annotations

import logging
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.reading.own_process import Name, arrays_of, write_arrays
from agent.reading.source import Arrays, Column
from calib.model import Slices

LEAST_MEMORY, COPIES = 1 << 30, 60  # bytes that reading may take: samples of 2 bytes become 8, idelib keeps copies
TIME = "time_s"
MICROSECOND = 1e-6


def open_ide(path: Path) -> Arrays:
    """Each channel is a group with `time_s` since the recorder's start and its subchannels, with the factory's
    calibration applied.

    Raises TableError; ImportError without idelib.
    """
    if find_spec("idelib") is None:
        raise ImportError("No module named 'idelib'", name="idelib")
    memory = LEAST_MEMORY + COPIES * path.stat().st_size
    values: dict[Column, Slices] = {
        Column(name, unit, group): array
        for (group, name, unit), array in arrays_of("agent.reading.ide", path, memory, "export it as CSV")
    }
    return Arrays(path, values)


def _arrays(path: str) -> dict[Name, NDArray[Any]]:
    """The samples of each channel, named by channel, subchannel and unit."""
    logging.disable()
    warnings.simplefilter("ignore")
    import idelib

    found: dict[Name, NDArray[Any]] = {}
    for channel in idelib.importFile(path, quiet=True).channels.values():
        for session in channel.sessions or ():
            samples = channel.getSession(session)
            if not len(samples) or (channel.name, TIME, "s") in found:
                continue
            table = np.asarray(samples.arraySlice(), dtype=np.float64)
            found[channel.name, TIME, "s"] = table[0] * MICROSECOND
            for subchannel, column in zip(channel.subchannels, table[1:], strict=True):
                found[channel.name, subchannel.name, subchannel.units[1] or ""] = column
    return found


if __name__ == "__main__":
    write_arrays(_arrays, *sys.argv[1:])
