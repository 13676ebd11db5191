"""Makes sample blocks of what a driver read: starts a block at each gap, counts the sample index, sets the flags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, SampleBlock
from hw.sensor import boot_id

MOST_BREAKS = 8  # in the half second of a stretch; more make blocks that are of no use


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
    flagged SATURATED. A device whose filter spreads what happens at the end of the range also spoils the `before`
    samples before such an indication and the `after` samples behind it: their blocks are flagged, too. Therefore the
    last bursts, with at least `before` samples, wait for the next stretch. A flag that is set while there is no sample
    goes to the next block. Rate and range may change when the device is opened again.
    """

    def __init__(
        self,
        device: str,
        nominal_rate_hz: float,
        lowest: float = -np.inf,
        highest: float = np.inf,
        *,
        before: int = 0,
        after: int = 0,
    ) -> None:
        self._device = device
        self.nominal_rate_hz = nominal_rate_hz
        self.lowest = lowest
        self.highest = highest
        self._before = before
        self._after = after
        self._index = 0
        self._flags = BlockFlags.NONE
        self._spoilt_to = -1  # index of the last sample that an indication at the end of the range has spoilt
        self._waiting: Stretch | None = None

    def flag(self, flags: BlockFlags, missing: int = 0) -> None:
        """Set flags of the next sample's block; the sample index jumps by `missing`."""
        self._flags |= flags
        self._index += missing

    def cut(self, stretch: Stretch, breaks: Sequence[Break] = ()) -> list[SampleBlock]:
        """Cut the samples that wait and a stretch into blocks of consecutive samples.

        `breaks` in ascending order of `at`, 0 <= at <= number of samples of the stretch.
        """
        waiting, self._waiting = self._waiting, None
        earlier = 0 if waiting is None else len(waiting.indications)
        if waiting is not None:
            stretch = _joined(waiting, stretch)
        blocks = []
        start = 0
        for point in breaks:
            blocks += self._block(stretch, start, earlier + point.at)
            self.flag(point.flags, point.missing)
            start = earlier + point.at
        n = len(stretch.indications)
        stop = self._last_stop(stretch, start) if n > earlier else n  # where nothing came, nothing is waited for
        blocks += self._block(stretch, start, stop)
        if stop < n:
            self._waiting = _from(stretch, stop)
        return blocks

    def flush(self) -> list[SampleBlock]:
        """Cut the samples that wait: what follows them is lost, or nothing follows."""
        waiting, self._waiting = self._waiting, None
        return [] if waiting is None else self._block(waiting, 0, len(waiting.indications))

    def _last_stop(self, stretch: Stretch, start: int) -> int:
        """The end of the last burst that `before` samples follow; `start` if there is none."""
        n = len(stretch.indications)
        ends = stretch.burst_count[stretch.burst_count <= n - self._before]
        return n if self._before == 0 else max(start, int(ends[-1])) if len(ends) else start

    def _block(self, stretch: Stretch, start: int, stop: int) -> list[SampleBlock]:
        if start == stop:
            return []
        count = np.clip(stretch.burst_count, start, stop) - start
        bringing = np.diff(count, prepend=0) > 0  # Bursts without a sample of this block tell nothing about its times.
        arrivals = stretch.burst_t_monotonic_ns[bringing]
        indications = stretch.indications[start:stop]
        if self._is_spoilt(stretch.indications[start : stop + self._before], stop - start):
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

    def _is_spoilt(self, indications: NDArray[np.int32] | NDArray[np.float64], n: int) -> bool:
        """Whether the end of the range spoils one of the first `n` of these samples, behind which others follow."""
        spoilt = self._index <= self._spoilt_to
        if indications.max() < self.highest and indications.min() > self.lowest:
            return spoilt
        at_end = np.flatnonzero(((indications >= self.highest) | (indications <= self.lowest)).any(axis=1))
        if len(own := at_end[at_end < n]):
            self._spoilt_to = self._index + int(own[-1]) + self._after
        return True


def _joined(first: Stretch, then: Stretch) -> Stretch:
    """Two stretches as one."""
    return replace(
        then,
        indications=np.concatenate([first.indications, then.indications]),
        burst_t_monotonic_ns=np.concatenate([first.burst_t_monotonic_ns, then.burst_t_monotonic_ns]),
        burst_count=np.concatenate([first.burst_count, len(first.indications) + then.burst_count]),
    )


def _from(stretch: Stretch, at: int) -> Stretch:
    """The samples from `at` on, where a burst begins."""
    later = stretch.burst_count > at
    return replace(
        stretch,
        indications=stretch.indications[at:],
        burst_t_monotonic_ns=stretch.burst_t_monotonic_ns[later],
        burst_count=stretch.burst_count[later] - at,
    )


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
