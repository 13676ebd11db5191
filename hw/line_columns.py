"""Columns of lines of text: their names, and what a sample counter or a time of the device tells of missing samples.

A counter of 8 bits cannot tell how many samples are missing, only that some are (OpenBCI_Cyton_Library, issue 110).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags
from hw.cutting import Break, follow

Column = Literal["seq", "millis", "micros", "x", "y", "z", "a", "temperature", "-"]
IGNORED: Column = "-"
AXES: Mapping[int, tuple[Column, ...]] = {1: ("a",), 3: ("x", "y", "z")}
COUNTER_SIZES = (2**8, 2**16, 2**32)  # numbers of a counter before it begins at 0 again
TICKS_HZ: Mapping[Column, float] = {"millis": 1e3, "micros": 1e6}
TICKS = 2.0**32  # of Arduino's millis() and micros() before they begin at 0 again
RATE_WITHIN = 0.02  # relative: how far the rate of a device may be from its nominal rate
TIME_WITHIN = 0.2  # relative: how far the usual step of a time may be from the nominal sample period
RISES = 0.9  # part of the steps of a counter that must be one

Values = NDArray[np.float64]


def columns_of(axes: int, sequence: bool) -> tuple[Column, ...]:
    """The columns `[seq,]x,y,z` or `[seq,]a`."""
    return ("seq", *AXES[axes]) if sequence else AXES[axes]


class SampleCounter:
    """Finds missing samples by a column that rises by one and begins at 0 again after 2^8, 2^16 or 2^32 numbers.

    Only the step from the last number to 0 is a wrap, or in a signed counter from the largest number to the smallest
    one. Any other step back is a RESTART, and so is the step behind a damaged number (see `damaged`). A counter that
    wraps within `longest_gap` samples does not tell how many are missing: each jump of it is a RESTART.
    """

    def __init__(self, longest_gap: float) -> None:
        self._longest_gap = longest_gap
        self.begin()

    def begin(self) -> None:
        """Forget the counter: the port was opened anew."""
        self._newest = np.empty(0)  # the last two numbers
        self._known_gap = self._longest_gap

    def breaks(self, counts: Values) -> list[Break]:
        """Breaks where the next of n > 0 numbers (n,) does not follow."""
        steps = np.diff(counts, prepend=self._newest[-1] if len(self._newest) else counts[0] - 1)
        if damaged(np.append(self._newest, counts[0]))[1:-1].any():  # it is handed on, and nothing is known behind it
            steps[0] = 0
        self._newest = np.append(self._newest, counts)[-2:]
        for at in np.flatnonzero(steps < 0).tolist():
            size = int(1 - steps[at])
            if size in COUNTER_SIZES and counts[at] in (0, -size // 2):
                self._known_gap = self._longest_gap if size > self._longest_gap else 0
                steps[at] = 1
        return follow(steps, self._known_gap)


def damaged(counts: Values) -> NDArray[np.bool_]:
    """Which numbers (n,) of a counter are damaged: those beside which let room for one number, and it is another."""
    found = np.zeros(len(counts), np.bool_)
    found[1:-1] = (counts[2:] - counts[:-2] == 2) & (counts[1:-1] != counts[:-2] + 1)
    return found


class DeviceTime:
    """Finds missing samples by the device's own time. The time is no clock: only the arrival of the lines is.

    A step of half a sample period too much, beside the resolution of the time, is a GAP if the number of missing
    samples is certain at a rate that is known within RATE_WITHIN; else it is a RESTART, as a step back is.
    """

    def __init__(self, ticks_hz: float, rate_hz: float, longest_gap: float) -> None:
        self._period = ticks_hz / rate_hz
        self._longest_gap = longest_gap
        self.begin()

    def begin(self) -> None:
        """Forget the time: the port was opened anew."""
        self._last: float | None = None

    def breaks(self, times: Values) -> list[Break]:
        """Breaks where the next of n > 0 times (n,) is not one sample period later."""
        steps = np.diff(times, prepend=times[0] - self._period if self._last is None else self._last) % TICKS
        steps /= self._period
        self._last = float(times[-1])
        resolution = 1 / self._period
        breaks = []
        for at in np.flatnonzero(np.abs(steps - 1) > 0.5 + resolution).tolist():
            samples = round(float(steps[at]))
            certain = resolution + RATE_WITHIN * samples < 0.5
            if certain and 1 < samples <= self._longest_gap + 1:
                breaks.append(Break(at, BlockFlags.GAP, samples - 1))
            else:
                breaks.append(Break(at, BlockFlags.RESTART))
        return breaks


def kind_of(values: Values, rate_hz: float) -> Column | None:
    """What a column (n,) is, by its steps: seq, millis, micros, or None of them.

    One step may be anything: opening a port restarts some boards.
    """
    steps = np.diff(values)
    if len(steps) < 2:
        return None
    ones = np.isin(steps, [1, *(1 - size for size in COUNTER_SIZES)])
    if (values % 1 == 0).all() and ones.mean() >= RISES and np.count_nonzero(~ones & (steps < 1)) <= 1:
        return "seq"
    for name, ticks_hz in TICKS_HZ.items():
        periods = steps % TICKS * rate_hz / ticks_hz
        steady = np.count_nonzero(periods > 1 / RATE_WITHIN) <= 1
        if steady and abs(np.median(periods) - 1) <= TIME_WITHIN:
            return name
    return None
