"""Two instruments at one place, written by ObsPy: MiniSEED and StationXML, with known sensitivity and orientation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

BEGIN = "2023-11-14T22:13:20"
STS2 = {"poles": [-0.03677 + 0.03703j, -0.03677 - 0.03703j], "zeros": [0j, 0j]}  # velocity, 120 s
SHORT = {"poles": [-4.443 + 4.443j, -4.443 - 4.443j], "zeros": [0j, 0j]}  # velocity, 1 Hz
ACCELEROMETER: dict[str, list[complex]] = {"poles": [-1500 + 1500j, -1500 - 1500j], "zeros": []}  # 340 Hz
DERIVATIVES = {"M/S": 1, "M/S**2": 0}


@dataclass(frozen=True)
class Channel:
    """A channel: its code, counts per unit at 1 Hz, and where it points."""

    code: str
    sensitivity: float
    azimuth_deg: float
    dip_deg: float

    @property
    def direction(self) -> np.ndarray:
        azimuth, dip = np.deg2rad([self.azimuth_deg, self.dip_deg])
        return np.array([np.cos(dip) * np.sin(azimuth), np.cos(dip) * np.cos(azimuth), -np.sin(dip)])


def ground(seconds: float, rate_hz: float, seed: int, low_hz: float = 0.5, high_hz: float = 8.0) -> np.ndarray:
    """Acceleration (n, 3) of the ground to east, north, up in m/s2: random, within a band, 0.3 m/s2 each."""
    n = int(seconds * rate_hz)
    f = np.fft.rfftfreq(n, 1 / rate_hz)
    spectrum = np.fft.rfft(np.random.default_rng(seed).normal(size=(n, 3)), axis=0)
    spectrum[(f < low_hz) | (f > high_hz)] = 0.0
    a = np.fft.irfft(spectrum, n, axis=0)
    return 0.3 * a / a.std(axis=0)


def indications(a: np.ndarray, rate_hz: float, channels: Sequence[Channel], paz: dict[str, Any], unit: str) -> Any:
    """Counts (n, k) of the channels for the acceleration `a` (n, 3), without rounding."""
    n = len(a)
    s = 2j * np.pi * np.fft.rfftfreq(n, 1 / rate_hz)
    response = _transfer(paz, s) / abs(_transfer(paz, np.array([2j * np.pi]))[0])
    with np.errstate(divide="ignore", invalid="ignore"):
        response = np.where(s == 0, 0.0 if DERIVATIVES[unit] else response, response / s ** DERIVATIVES[unit])
    columns = []
    for channel in channels:
        along = np.fft.rfft(a @ channel.direction)
        columns.append(channel.sensitivity * np.fft.irfft(response * along, n))
    return np.column_stack(columns)


def _transfer(paz: dict[str, Any], s: np.ndarray) -> np.ndarray:
    zeros = np.prod([s - z for z in paz["zeros"]], axis=0) if paz["zeros"] else np.ones(len(s))
    return np.asarray(zeros / np.prod([s - p for p in paz["poles"]], axis=0))


def write_mseed(path: Path, station: str, channels: Sequence[Channel], counts: np.ndarray, rate_hz: float) -> None:
    """MiniSEED of 32-bit counts, compressed by Steim 2."""
    import obspy

    about = {"network": "XX", "station": station, "sampling_rate": rate_hz, "starttime": obspy.UTCDateTime(BEGIN)}
    traces = [
        obspy.Trace(np.ascontiguousarray(np.round(column).astype(np.int32)), about | {"channel": channel.code})
        for channel, column in zip(channels, counts.T, strict=True)
    ]
    obspy.Stream(traces).write(str(path), format="MSEED")


@dataclass(frozen=True)
class Station:
    """A station of one instrument as its metadata describe it."""

    code: str
    channels: Sequence[Channel]
    rate_hz: float
    paz: dict[str, Any]
    unit: str = "M/S"
    network: str = "XX"
    since: int = 2000


def write_stationxml(path: Path, stations: Sequence[Station]) -> None:
    """StationXML of the stations, each response with one stage of poles and zeros."""
    from obspy import UTCDateTime
    from obspy.core.inventory import Channel as Described
    from obspy.core.inventory import Inventory, Network
    from obspy.core.inventory import Station as DescribedStation
    from obspy.core.inventory.response import Response

    networks = []
    for station in stations:
        told = []
        whole: dict[str, Any] = {"input_units": station.unit, "output_units": "COUNTS"}
        whole["normalization_factor"] = 1.0 / abs(_transfer(station.paz, np.array([2j * np.pi]))[0])
        for c in station.channels:
            response = Response.from_paz(station.paz["zeros"], station.paz["poles"], c.sensitivity, 1.0, **whole)
            about = {"azimuth": c.azimuth_deg, "dip": c.dip_deg, "sample_rate": station.rate_hz, "response": response}
            told.append(Described(c.code, "", 0, 0, 0, 0, start_date=UTCDateTime(station.since, 1, 1), **about))
        networks.append(Network(station.network, [DescribedStation(station.code, 0, 0, 0, channels=told)]))
    Inventory(networks, source="test").write(str(path), format="STATIONXML")
