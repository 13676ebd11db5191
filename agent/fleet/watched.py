"""Reads hourly `watch` results from files of JSON lines, in any order, and gives them day by day.

The files are read twice: once to check each line and to note where the hours of each day stand, and once day by day.
So a year of many sensors needs little memory, and the lines need not be sorted. A line that cannot be used is
counted by its reason, never fatal; the first one of each reason is told with file and line.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path

import msgspec
import numpy as np

from agent.config.files import open_file
from calib.model import Array
from calib.site_watch.day import HOURS, Day, Hours, day_of

HOUR_NS = 3_600_000_000_000
LONGEST_LINE = 1 << 20  # bytes
LARGEST = 1e12  # (m/s²)²; beyond it no acceleration is believed
MOST_SENSORS = 4000
LEAST_COVERED_S = 1800.0  # of an hour that counts
MOST_WRONG = 0.01  # part of the samples of an hour that may be stuck or clipped
BANDS = range(-12, 31)  # third octaves n: 10^(n/10) Hz
GRID = 0.02  # relative distance from a nominal centre (IEC 61260-1, base 10)
YEARS_H = (262_968, 1_139_568)  # 2000 to 2100, in hours since 1970


class WatchError(Exception):
    """No line of the files can be used. The message says why."""


Numbers = list[float | None]


class WatchLine(msgspec.Struct, kw_only=True):
    """A `watch` result as it is published. `key`, `site` and `gateway` say where it comes from."""

    sensor: str
    hour_utc_ns: int
    duration_s: float
    samples: int
    noise_psd: Numbers
    band_hz: list[float]
    band_power: Numbers
    cross_power: Numbers
    key: str = ""
    site: str = ""
    gateway: str = ""
    sequence: int = 0
    stuck: int = 0
    clipped: int = 0
    temperature_degc: float | None = None
    calibration_run_id: str = ""
    calibration_sequence: int = 0
    u_main_pct: Numbers = []


@dataclass(slots=True)
class Watched:
    """What the files hold. `sensors`: (gateway, sensor) by number. `left_out`: lines by reason; `first`: where each
    reason was met first. `places`: of each day, {(sensor, hour): (sequence, file, offset)}."""

    files: Sequence[Path]
    sensors: list[tuple[str, str]] = field(default_factory=list)
    bands: list[int] = field(default_factory=list)
    lines: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    first: dict[str, str] = field(default_factory=dict)
    places: dict[int, dict[tuple[int, int], tuple[int, int, int]]] = field(default_factory=dict)
    u_main: dict[int, float] = field(default_factory=dict)  # relative, of the calibration in force, by sensor

    @property
    def band_hz(self) -> Array:
        """Nominal centres of all bands that any line has."""
        return np.asarray(10.0 ** (np.array(self.bands) / 10.0))

    @property
    def gateways(self) -> list[str]:
        """Names of the gateways, by number."""
        return sorted({gateway for gateway, _ in self.sensors})

    def days(self) -> Iterator[tuple[Day, Array]]:
        """Each day that has lines, in order, with the sensors whose calibration changed in it (n,)."""
        calibration: dict[int, tuple[str, int]] = {}
        with ExitStack() as stack:
            opened = [stack.enter_context(open_file(path)) for path in self.files]
            for number in sorted(self.places):
                hours, visited = self._hours(number, opened, calibration)
                yield day_of(hours, self.band_hz), visited

    def _hours(
        self, number: int, opened: list[BufferedReader], calibration: dict[int, tuple[str, int]]
    ) -> tuple[Hours, Array]:
        n, bands = len(self.sensors), {band: k for k, band in enumerate(self.bands)}
        power, cross = (np.full((HOURS, n, len(bands), 3), np.nan) for _ in range(2))
        noise, degc = np.full((HOURS, n, 3), np.nan), np.full((HOURS, n), np.nan)
        visited = np.zeros(n, dtype=bool)
        for (i, hour), (_, file, offset) in sorted(self.places[number].items(), key=lambda item: item[0][::-1]):
            opened[file].seek(offset)
            line = msgspec.json.decode(opened[file].readline(LONGEST_LINE), type=WatchLine)
            h, at = hour - HOURS * number, [bands[band] for band in _grid(line.band_hz)]
            power[h, i, at] = _matrix(line.band_power)
            cross[h, i, at] = _matrix(line.cross_power)
            noise[h, i] = _array(line.noise_psd)
            degc[h, i] = np.nan if line.temperature_degc is None else line.temperature_degc
            made = line.calibration_run_id, line.calibration_sequence
            visited[i] |= calibration.setdefault(i, made) != made
            calibration[i] = made
        return Hours(HOURS * number + np.arange(HOURS, dtype=float), power, cross, noise, degc), visited


def watched(files: Sequence[Path]) -> Watched:
    """Check all lines of the files. Raises OSError, or WatchError where no line can be used."""
    found, bands = Watched(files), set[int]()
    numbers: dict[tuple[str, str], int] = {}
    for k, path in enumerate(files):
        with open_file(path) as file:
            offset, place = 0, 0
            while data := file.readline(LONGEST_LINE):
                place += 1
                if data.strip():
                    found.lines += 1
                    reason = _taken(found, numbers, bands, (k, offset), data, path.stem)
                    if reason:
                        found.left_out[reason] += 1
                        found.first.setdefault(reason, f"{path}:{place}")
                offset += len(data)
    if not found.places:
        told = "; ".join(f"{reason}, first at {found.first[reason]}" for reason in found.left_out)
        raise WatchError(f"no line is an hourly result of a sensor ({told or 'the files are empty'})")
    found.bands = sorted(bands)
    return found


def _taken(
    found: Watched, numbers: dict[tuple[str, str], int], bands: set[int], at: tuple[int, int], data: bytes, stem: str
) -> str:
    """Note a line. Returns why it is left out; "" where it is used."""
    if len(data) >= LONGEST_LINE:
        return f"a line of more than {LONGEST_LINE} bytes"
    try:
        line = msgspec.json.decode(data, type=WatchLine)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        return f"not a watch result: {_short(str(error))}"
    reason = _wrong(line)
    if reason:
        return reason
    who = line.gateway or _named(line.key) or stem, line.sensor
    if who not in numbers and len(numbers) >= MOST_SENSORS:
        return f"more than {MOST_SENSORS} sensors"
    i = numbers.setdefault(who, len(numbers))
    if i == len(found.sensors):
        found.sensors.append(who)
    hour = line.hour_utc_ns // HOUR_NS
    day = found.places.setdefault(hour // HOURS, {})
    before = day.get((i, hour))
    if before is None or before[0] <= line.sequence:
        day[i, hour] = line.sequence, *at
        bands.update(_grid(line.band_hz))
        if (u := _largest_u(line)) is not None:
            found.u_main[i] = u
    return "" if before is None else "an hour of a sensor twice; the one with the higher sequence is used"


def _largest_u(line: WatchLine) -> float | None:
    """The largest relative U of the main sensitivities; None where none is told."""
    return max((u / 100.0 for u in line.u_main_pct if u is not None and u > 0.0), default=None)


def _named(key: str) -> str:
    """The gateway that a key of Zenoh names; "" where it is no key of a result."""
    parts = key.split("/")
    return parts[3] if len(parts) == 6 and parts[:2] == ["fieldcal", "v1"] else ""


def _wrong(line: WatchLine) -> str:
    """Why the content of a line cannot be used; "" where it can."""
    b = len(line.band_hz)
    hour, odd = divmod(line.hour_utc_ns, HOUR_NS)
    lengths = len(line.band_power), len(line.cross_power), len(line.noise_psd)
    numbers = [*line.band_power, *line.cross_power, *line.noise_psd]
    rules = (
        (odd or not YEARS_H[0] <= hour < YEARS_H[1], "hour_utc_ns is not the begin of an hour between 2000 and 2100"),
        (not b or lengths != (3 * b, 3 * b, 3),
         "band_power and cross_power do not have three values for each of band_hz, or noise_psd not three"),
        (len(set(_grid(line.band_hz))) != b,
         "band_hz are not third octaves 10^(n/10) Hz between 0.06 and 1000 Hz, each once"),
        (any(value is not None and not abs(value) <= LARGEST for value in numbers),
         f"a power is beyond {LARGEST:g} (m/s2)2"),
        (line.temperature_degc is not None and not -100.0 <= line.temperature_degc <= 200.0,
         "temperature_degc is not between -100 and 200"),
        (not line.duration_s >= LEAST_COVERED_S or line.samples <= 0,
         f"less than {LEAST_COVERED_S:g} s of the hour are covered"),
        (line.stuck + line.clipped > MOST_WRONG * line.samples,
         f"more than {100.0 * MOST_WRONG:g} % of the samples are stuck or clipped"),
    )  # fmt: skip
    return next((message for broken, message in rules if broken), "")


def _grid(band_hz: list[float]) -> list[int]:
    """Numbers n of third octaves; of frequencies that are none, nothing."""
    numbers = []
    for f in band_hz:
        n = round(10.0 * math.log10(f)) if 1e-3 < f < 1e6 else BANDS.start - 1
        if n in BANDS and abs(f / 10.0 ** (n / 10.0) - 1.0) <= GRID:
            numbers.append(n)
    return numbers


def _array(values: Numbers) -> Array:
    return np.array([np.nan if value is None else value for value in values])


def _matrix(values: Numbers) -> Array:
    """(B, 3) from all bands of the first, then the second, then the third."""
    return _array(values).reshape(3, -1).T


def _short(text: str) -> str:
    return text if len(text) <= 120 else f"{text[:120]}…"
