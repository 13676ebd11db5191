"""MiniSEED of samples, written by ObsPy in records of 512 bytes as 64-bit numbers."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from agent.config.whole_files import new_file
from agent.export.samples import ExportedSamples, ExportError, RecordedContent
from agent.export.tables import columns

NETWORK = "XX"  # of the FDSN: for data that belong to no registered network
INDICATION, ACCELERATION = "00", "10"  # location codes
# Band codes of SEED for instruments that respond down to 10 s and below, each from this rate on in Hz.
BANDS = ((1000.0, "F"), (250.0, "C"), (80.0, "H"), (10.0, "B"), (1.0, "M"), (0.0, "L"))


def write_mseed(path: Path, content: RecordedContent, blocks: Iterable[ExportedSamples]) -> int:
    """Write a channel for each axis: indications at location 00, accelerations in m/s2 at location 10.

    Each block begins with its own time; the rate is that of the first block. Raises ExportError without ObsPy.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ObsPy's own, about packages that it uses
        try:
            from obspy import Stream, Trace, UTCDateTime
        except ImportError:
            raise ExportError(
                f"{path}: MiniSEED needs ObsPy; install it with: fieldcal extras --install seismic"
            ) from None
        rows, rate_hz = 0, 0.0
        station = station_code(content.device)
        with new_file(path) as file:
            for block in blocks:
                rate_hz = rate_hz or rate_of(block)
                about = {
                    "network": NETWORK, "station": station, "sampling_rate": rate_hz,
                    "starttime": UTCDateTime(ns=int(block.t_utc_ns[0])),
                }  # fmt: skip
                stream = Stream()
                for k, values in enumerate(columns(content, block).T):
                    location = INDICATION if k < content.axes else ACCELERATION
                    names = {"location": location, "channel": channel_code(rate_hz, k % content.axes)}
                    stream.append(Trace(np.ascontiguousarray(values), about | names))
                stream.write(file, format="MSEED", encoding="FLOAT64", reclen=512)
                rows += len(block.values)
    return rows


def rate_of(block: ExportedSamples) -> float:
    """The rate in Hz, as precise as a record of MiniSEED has it."""
    return float(np.float32(block.rate_hz))


def station_code(device: str) -> str:
    """The station of a device: the letters and digits of its name, five at most."""
    return re.sub("[^A-Z0-9]", "", device.upper())[:5] or "FIELD"


def channel_code(rate_hz: float, axis: int) -> str:
    """The channel of an axis (from 0 on) of an accelerometer with this rate."""
    code = next(letter for least_hz, letter in BANDS if rate_hz >= least_hz)
    return f"{code}N{axis + 1}"
