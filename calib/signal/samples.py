"""Consecutive samples of one device, with the clock that gives the time of each sample."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from calib.model import Array
from calib.signal.timing import ClockFit


@dataclass(frozen=True, eq=False)
class Samples:
    """Consecutive samples of a device; a missing sample is a row of NaN.

    `device` is the name for messages. `values` (n, C) are in the device's own unit; the first row has the sample number
    `first_index`. `clock` gives the time of each sample. `saturated`: at least one sample was at the end of the
    device's range. `in_time`: the times rise and lie in the interval that was asked for; false if the device's sample
    count jumps, so that no clock can be fitted. `temperature_degc` is the mean temperature, NaN if the device measures
    none.
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
        """Number of the device's axes."""
        return int(self.values.shape[1])

    @cached_property
    def time_s(self) -> Array:
        """(n,) time of each sample in s, by `clock`; computed when it is first asked for."""
        return self.clock.times_of(self.first_index, len(self.values))


class Stream(Protocol):
    """All samples of one device, read from a file or received live."""

    def cut(self, start_s: float, stop_s: float) -> Samples | None:
        """The samples taken in the interval [start_s, stop_s), in s; None if there are none."""
