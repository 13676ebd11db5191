"""Makes sample blocks of what a driver read: starts a block at each gap, counts the sample index, sets the flags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, SampleBlock
from hw.sensor import boot_id


@dataclass(frozen=True, slots=True)
class Break:
    """Sample `at` of a stretch does not follow sample `at - 1`; `missing` samples lie between, if the number is
    known."""

    at: int
    flags: BlockFlags
    missing: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """The samples of about half a second. `burst_count[b]` samples had been read when burst b arrived (cumulative)."""

    indications: NDArray[np.int32] | NDArray[np.float64]
    burst_t_monotonic_ns: NDArray[np.int64]
    burst_count: NDArray[np.int64]
    t_utc_ns: int  # UTC at the arrival of the last burst
    temperature_raw: int | None = None
    temperature_degc: float | None = None


class Cutter:
    """Numbers a device's samples over the whole run and cuts stretches into blocks.

    A block with an indication at or beyond `lowest` or `highest` (ends of the range, in the unit of the indications) is
    flagged SATURATED. A flag that is set while there is no sample goes to the next block. Rate and range may change
    when the device is opened again.
    """

    def __init__(self, device: str, nominal_rate_hz: float, lowest: float = -np.inf, highest: float = np.inf) -> None:
        self._device = device
        self.nominal_rate_hz = nominal_rate_hz
        self.lowest = lowest
        self.highest = highest
        self._index = 0
        self._flags = BlockFlags.NONE

    def flag(self, flags: BlockFlags, missing: int = 0) -> None:
        """Set flags of the next sample's block; the sample index jumps by `missing`."""
        self._flags |= flags
        self._index += missing

    def cut(self, stretch: Stretch, breaks: Sequence[Break] = ()) -> list[SampleBlock]:
        """Cut a stretch into blocks of consecutive samples.

        `breaks` in ascending order of `at`, 0 <= at <= number of samples.
        """
        blocks = []
        start = 0
        for point in breaks:
            blocks += self._block(stretch, start, point.at)
            self.flag(point.flags, point.missing)
            start = point.at
        return blocks + self._block(stretch, start, len(stretch.indications))

    def _block(self, stretch: Stretch, start: int, stop: int) -> list[SampleBlock]:
        if start == stop:
            return []
        count = np.clip(stretch.burst_count, start, stop) - start
        bringing = np.diff(count, prepend=0) > 0  # Bursts without a sample of this block tell nothing about its times.
        arrivals = stretch.burst_t_monotonic_ns[bringing]
        indications = stretch.indications[start:stop]
        if indications.max() >= self.highest or indications.min() <= self.lowest:
            self._flags |= BlockFlags.SATURATED
        block = SampleBlock(
            device=self._device,
            boot_id=boot_id(),
            t_utc_ns=stretch.t_utc_ns - int(stretch.burst_t_monotonic_ns[-1] - arrivals[-1]),
            first_index=self._index,
            nominal_rate_hz=self.nominal_rate_hz,
            burst_t_monotonic_ns=arrivals,
            burst_count=count[bringing].astype(np.int32),
            indications=indications,
            flags=self._flags,
            temperature_raw=stretch.temperature_raw,
            temperature_degc=stretch.temperature_degc,
        )
        self._flags = BlockFlags.NONE
        self._index += stop - start
        return [block]


def follow(steps: NDArray[np.int64] | NDArray[np.float64], longest_gap: float) -> list[Break]:
    """Breaks of a sample counter, from its steps (n,) between samples.

    A step of 1 is no break. A step of 2 to `longest_gap` is a GAP of known length. A step of 0, a negative step or a
    step above `longest_gap` is a RESTART.
    """
    breaks = []
    for at in np.flatnonzero(steps != 1).tolist():
        missing = int(steps[at]) - 1
        if 0 < missing <= longest_gap:
            breaks.append(Break(at, BlockFlags.GAP, missing))
        else:
            breaks.append(Break(at, BlockFlags.RESTART))
    return breaks
