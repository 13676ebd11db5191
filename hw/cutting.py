"""Makes sample blocks of what a driver read: cuts where samples are not consecutive, keeps the index and the flags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, SampleBlock
from hw.sensor import boot_id


@dataclass(frozen=True, slots=True)
class Break:
    """Sample `at` of a stretch is not the next one after sample `at - 1`; `missing` samples lie between, if known."""

    at: int
    flags: BlockFlags
    missing: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """What came in about half a second. `burst_count[b]` samples had been read when burst b arrived (cumulative)."""

    indications: NDArray[np.int32] | NDArray[np.float64]
    burst_t_monotonic_ns: NDArray[np.int64]
    burst_count: NDArray[np.int64]
    t_utc_ns: int  # UTC at the last burst's arrival
    temperature_raw: int | None = None
    temperature_degc: float | None = None


class Cutter:
    """Numbers a device's samples through its life and cuts stretches into blocks.

    `lowest` and `highest` are the ends of the range, in the indications' unit: an indication there is SATURATED.
    Flags that no sample could carry yet wait for the next one. Rate and ends may
    change when a device is opened.
    """

    def __init__(self, device: str, nominal_rate_hz: float, lowest: float = -np.inf, highest: float = np.inf) -> None:
        self._device = device
        self.nominal_rate_hz = nominal_rate_hz
        self.lowest = lowest
        self.highest = highest
        self._index = 0
        self._flags = BlockFlags.NONE

    def flag(self, flags: BlockFlags, missing: int = 0) -> None:
        """What the next sample's block must carry, and how far its index jumps."""
        self._flags |= flags
        self._index += missing

    def cut(self, stretch: Stretch, breaks: Sequence[Break] = ()) -> list[SampleBlock]:
        """Blocks of consecutive samples; `breaks` in rising order of `at`, 0 <= at <= number of samples."""
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
        bringing = np.diff(count, prepend=0) > 0  # the others say nothing of this block's times
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
    """Breaks of a count by its steps (n,) from sample to sample: a longer step than one is a GAP of known length, none,
    one backwards or one beyond `longest_gap` a RESTART."""
    breaks = []
    for at in np.flatnonzero(steps != 1).tolist():
        missing = int(steps[at]) - 1
        if 0 < missing <= longest_gap:
            breaks.append(Break(at, BlockFlags.GAP, missing))
        else:
            breaks.append(Break(at, BlockFlags.RESTART))
    return breaks
