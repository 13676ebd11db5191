"""The newest samples of one device, with the clock that says when each was taken."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.timing import ClockFit, ClockModel
from hw.block import BlockFlags, SampleBlock


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """Samples between two times, one after the other without a hole: what is missing is NaN.

    `indications` (n, C) from sample `first_index` on; `clock` says when each was taken.
    """

    first_index: int
    indications: NDArray[np.float64]
    clock: ClockFit
    saturated: bool

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(n,) in seconds since the run's origin."""
        return self.clock.time_of(self.first_index + np.arange(len(self.indications)))


class DeviceStream:
    """Blocks of one device as they come, forgotten when `forget_before` says so.

    Times are seconds since the run's origin on the gateway's monotonic clock. A RESTART (the index does not go on in
    time) empties the buffer and starts the clock model anew; `broken_s` is when that last happened.
    """

    def __init__(self, origin_ns: int) -> None:
        self._origin_ns = origin_ns
        self._blocks: deque[SampleBlock] = deque()
        self._clock: ClockModel | None = None
        self._fitted: ClockFit | None = None  # the clock model's result, until the next block
        self.newest_arrival_s: float | None = None
        self.first_sample_s: float | None = None
        self.broken_s: float | None = None

    def update(self, block: SampleBlock) -> None:
        """Take the next block."""
        arrivals_s = (block.burst_t_monotonic_ns - self._origin_ns) * 1e-9
        first_arrival_s = float(arrivals_s[0])
        if self._clock is None:
            self._clock = ClockModel(block.nominal_rate_hz)
            self.first_sample_s = first_arrival_s - int(block.burst_count[0]) / block.nominal_rate_hz
        elif block.flags & BlockFlags.RESTART:
            self._clock = ClockModel(block.nominal_rate_hz)
            self._blocks.clear()
            self.broken_s = first_arrival_s
        self._clock.update(block.first_index + block.burst_count.astype(np.int64) - 1, arrivals_s)
        self._fitted = None
        self._blocks.append(block)
        self.newest_arrival_s = float(arrivals_s[-1])

    def reaches(self, time_s: float) -> bool:
        """Whether samples up to `time_s` are there."""
        # A sample never arrives before it was taken: as long as nothing arrived since, the clock need not be asked.
        if self.newest_arrival_s is None or self.newest_arrival_s < time_s or not self._blocks:
            return False
        newest = self._blocks[-1]
        return bool(self._fit().time_of(newest.first_index + newest.n - 1) >= time_s)

    def _fit(self) -> ClockFit:
        if self._fitted is None:
            assert self._clock is not None  # there are blocks
            self._fitted = self._clock.result()
        return self._fitted

    def cut(self, start_s: float, stop_s: float) -> Cut | None:
        """All samples with start_s <= t < stop_s by the clock model as it is now; None if there are none."""
        if not self._blocks:
            return None
        clock = self._fit()
        first, stop = (int(np.ceil(i)) for i in clock.index_of(np.array([start_s, stop_s])))
        first = max(first, self._blocks[0].first_index)
        stop = min(stop, self._blocks[-1].first_index + self._blocks[-1].n)
        if stop <= first:
            return None
        held = np.full((stop - first, self._blocks[0].indications.shape[1]), np.nan)
        saturated = False
        for block in self._blocks:
            a, b = max(first, block.first_index), min(stop, block.first_index + block.n)
            if a < b:
                held[a - first : b - first] = block.indications[a - block.first_index : b - block.first_index]
                saturated |= bool(block.flags & BlockFlags.SATURATED)
        return Cut(first, held, clock, saturated)

    def forget_before(self, time_s: float) -> None:
        """Drop whole blocks that ended before `time_s` (by arrival, which is never early)."""
        while len(self._blocks) > 1 and (self._blocks[0].t_monotonic_ns - self._origin_ns) * 1e-9 < time_s:
            self._blocks.popleft()

    def snapshot(self) -> dict[str, Any]:
        """State for `restore`, bit-exact."""
        return {
            "clock": self._clock.snapshot() if self._clock else None,
            "nominal_rate_hz": self._blocks[-1].nominal_rate_hz if self._blocks else 0.0,
            "blocks": [_block_state(block) for block in self._blocks],
            "newest_arrival_s": self.newest_arrival_s,
            "first_sample_s": self.first_sample_s,
            "broken_s": self.broken_s,
        }

    @classmethod
    def restore(cls, origin_ns: int, state: dict[str, Any]) -> DeviceStream:
        """The stream whose `snapshot` this is."""
        stream = cls(origin_ns)
        if state["clock"] is not None:
            stream._clock = ClockModel.restore(state["clock"])
        stream._blocks.extend(_block_of(s) for s in state["blocks"])
        stream.newest_arrival_s = state["newest_arrival_s"]
        stream.first_sample_s = state["first_sample_s"]
        stream.broken_s = state["broken_s"]
        return stream


def _block_state(block: SampleBlock) -> dict[str, Any]:
    state = {name: getattr(block, name) for name in SampleBlock.__slots__}
    return state | {"flags": int(block.flags)}


def _block_of(state: dict[str, Any]) -> SampleBlock:
    return SampleBlock(**(state | {"flags": BlockFlags(state["flags"])}))
