"""Samples of one device between two times, with the clock that says when each was taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calib.model import Array
from calib.signal.timing import ClockFit


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Samples of a device one after the other; a missing sample is a row of NaN.

    `device` names it in messages. `values` (n, C) in the device's own unit, the first of them has the number
    `first_index`; `clock` says when each was taken. `in_time`: the times rise and lie where they were asked for (a
    device whose count jumps at will has no clock). `saturated`: a sample was at the end of the device's range.
    `temperature_degc` is the mean, NaN where the device tells none.
    """

    device: str
    first_index: int
    values: Array
    clock: ClockFit
    saturated: bool = False
    in_time: bool = True
    temperature_degc: float = float("nan")

    @property
    def axes(self) -> int:
        """Axes of the device."""
        return int(self.values.shape[1])

    @property
    def time_s(self) -> Array:
        """(n,) when each sample was taken, in s of the clock."""
        return self.clock.time_of(self.first_index + np.arange(len(self.values)))


class Stream(Protocol):
    """Samples of one device, from a file or as they come."""

    def cut(self, start_s: float, stop_s: float) -> Samples | None:
        """The samples taken from `start_s` to before `stop_s`; None where there is none."""
