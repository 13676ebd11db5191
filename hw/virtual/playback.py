"""Plays a CSV recording as a device that sends the serial text protocol, at the speed of the recording."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SIGNALS = (("vx", "vy", "vz"), ("ax", "ay", "az"), ("a",), ("v",))  # column names of sensor.csv and reference.csv


class PlaybackError(Exception):
    """The file cannot be played; the message names file, line, column and value."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Data to be sent: the times (N,) in s since the first sample, and the values (N) as written in the file."""

    time_s: NDArray[np.float64]
    values: list[str]


def _lines_of(path: Path) -> list[str]:
    try:
        if path.exists() and not path.is_file():
            raise PlaybackError(f"{path}: not a regular file")
        return path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise PlaybackError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_track(path: Path, columns: tuple[str, ...] | None = None, rate_hz: float | None = None) -> Track:
    """Read the columns to be sent, by default those of sensor.csv or reference.csv as `fieldcal calibrate` reads them.

    The times come from the column `time_s`, or from `rate_hz` if it is given. Raises PlaybackError.
    """
    lines = _lines_of(path)
    header = [name.strip() for name in lines[0].split(",")] if lines else []
    wanted = _wanted(path, header, columns, rate_hz)
    width, places = len(header), [header.index(name) for name in wanted]
    numbers: list[list[float]] = []
    values: list[str] = []
    for number, line in enumerate(lines[1:], start=2):
        fields = line.split(",")
        if len(fields) != width:
            if not line.strip():
                continue
            raise PlaybackError(f"{path}, line {number}: {len(fields)} fields, the header has {width}")
        row = [_number(path, number, header[place], fields[place]) for place in places]
        numbers.append(row)
        values.append(",".join(fields[place].strip() for place in (places if rate_hz else places[1:])))
    if not values:
        raise PlaybackError(f"{path}: no samples")
    if rate_hz:
        return Track(np.arange(len(values)) / rate_hz, values)
    time_s = np.array([row[0] for row in numbers])
    _check_rising(path, time_s)
    return Track(time_s - time_s[0], values)


def _check_rising(path: Path, time_s: NDArray[np.float64]) -> None:
    backwards = np.flatnonzero(np.diff(time_s) < 0)
    if len(backwards):
        at = int(backwards[0]) + 1
        raise PlaybackError(
            f"{path}, sample {at + 1}, column time_s: {time_s[at]} is earlier than {time_s[at - 1]} before it"
        )


def _wanted(path: Path, header: list[str], columns: tuple[str, ...] | None, rate_hz: float | None) -> list[str]:
    """Names of the columns to read; time_s is the first if the times come from it."""
    if columns is None:
        columns = next((names for names in SIGNALS if set(names) <= set(header)), None)
        if columns is None:
            signals = " or ".join(",".join(names) for names in SIGNALS)
            raise PlaybackError(f"{path}, line 1: none of the columns {signals} in the header {','.join(header)!r}")
    wanted = [*columns] if rate_hz else ["time_s", *columns]
    for name in wanted:
        if name not in header:
            raise PlaybackError(f"{path}, line 1: no column {name} in the header {','.join(header)!r}")
    return wanted


def _number(path: Path, line: int, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise PlaybackError(f"{path}, line {line}, column {column}: {text.strip()!r} is not a finite number")
    return value


class Player:
    """Text of a track that is due, for `hw.virtual.serial_port.PtyDevice`; no text before `begin`.

    With `loop` the track starts again one mean sample interval after its end, without limit.
    """

    def __init__(self, track: Track, *, sequence: bool = False, loop: bool = False) -> None:
        self._track = track
        self._sequence = sequence
        self._loop = loop
        self._zero_s: float | None = None
        self._sent = 0
        n = len(track.values)
        self._duration_s = float(track.time_s[-1]) * n / max(n - 1, 1)

    def begin(self, t_s: float) -> None:
        """The first sample is due at `t_s` of the device's clock."""
        self._zero_s = t_s

    @property
    def finished(self) -> bool:
        """Whether the whole track has been sent."""
        return not self._loop and self._sent == len(self._track.values)

    def __call__(self, t_s: float) -> bytes:
        if self._zero_s is None:
            return b""
        due = self._due(t_s - self._zero_s)
        lines = [self._line(k) for k in range(self._sent, due)]
        # A reader discards the line during which it opened the port: this comment is sent to be that line.
        greeting = "# playing\n" if lines and not self._sent else ""
        self._sent = max(due, self._sent)
        return (greeting + "".join(lines)).encode("ascii", "replace")

    def _due(self, elapsed_s: float) -> int:
        turns = int(elapsed_s // self._duration_s) if self._loop and self._duration_s > 0 else 0
        within = np.searchsorted(self._track.time_s, elapsed_s - turns * self._duration_s, side="right")
        return turns * len(self._track.values) + int(within)

    def _line(self, k: int) -> str:
        text = self._track.values[k % len(self._track.values)]
        return f"{k},{text}\n" if self._sequence else text + "\n"
