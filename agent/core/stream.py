"""The newest samples of one device, with the clock that says when each was taken."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from calib.model import Array
from calib.signal.samples import Samples
from calib.signal.timing import HORIZON_S, ClockFit, ClockModel
from hw.block import BlockFlags, SampleBlock

# Times its nominal rate, more than any clock is off: a count in microseconds, say, is none of samples, and the holes
# in it would fill the memory.
FASTEST = 10.0


class DeviceStream:
    """Blocks of one device as they come, forgotten when `forget_before` says so.

    Times are seconds since the run's origin on the gateway's monotonic clock. A RESTART (the index does not go on in
    time) empties the buffer and starts the clock model anew.
    """

    def __init__(self, name: str, origin_ns: int, horizon_s: float = HORIZON_S) -> None:
        """`horizon_s`: how far back the clock model must know the times."""
        self._name = name
        self._origin_ns = origin_ns
        self._horizon_s = horizon_s
        self._blocks: deque[SampleBlock] = deque()
        self._clock: ClockModel | None = None
        self._fitted: ClockFit | None = None  # the clock model's result, until the next block
        self.newest_arrival_s: float | None = None
        self.first_sample_s: float | None = None

    def update(self, block: SampleBlock) -> None:
        """Take the next block."""
        arrivals_s = (block.burst_t_monotonic_ns - self._origin_ns) * 1e-9
        first_arrival_s = float(arrivals_s[0])
        if self._clock is None:
            self._clock = ClockModel(block.nominal_rate_hz, self._horizon_s)
            self.first_sample_s = first_arrival_s - int(block.burst_count[0]) / block.nominal_rate_hz
        elif block.flags & BlockFlags.RESTART:
            self._clock = ClockModel(block.nominal_rate_hz, self._horizon_s)
            self._blocks.clear()
        self._clock.update(block.first_index + block.burst_count.astype(np.int64) - 1, arrivals_s)
        self._fitted = None
        self._blocks.append(block)
        self.newest_arrival_s = float(arrivals_s[-1])

    @property
    def nominal_rate_hz(self) -> float | None:
        """As the newest block tells it; None before any."""
        return self._blocks[-1].nominal_rate_hz if self._blocks else None

    def reaches(self, time_s: float) -> bool:
        """Whether samples up to `time_s` are there."""
        # A sample never arrives before it was taken: as long as nothing arrived since, the clock need not be asked.
        if self.newest_arrival_s is None or self.newest_arrival_s < time_s or not self._blocks:
            return False
        newest = self._blocks[-1]
        return bool(self._fit().time_of(newest.first_index + newest.n - 1) >= time_s)

    def taken_at(self, index: int) -> tuple[float, float]:
        """(time in s since the origin, rate in Hz) of a sample, by the clock as it is now."""
        clock = self._fit()
        return float(clock.time_of(index)), clock.rate_hz

    def clock(self) -> tuple[ClockFit, Array]:
        """The clock as it is now, and how late each burst behind it arrived (B,) in s. There must be a block."""
        clock = self._fit()
        assert self._clock is not None
        return clock, self._clock.lateness_s(clock)

    def _fit(self) -> ClockFit:
        if self._fitted is None:
            assert self._clock is not None  # there are blocks
            self._fitted = self._clock.result()
        return self._fitted

    def cut(self, start_s: float, stop_s: float) -> Samples | None:
        """All samples with start_s <= t < stop_s by the clock model as it is now; None if there are none."""
        if not self._blocks:
            return None
        clock, rate_hz, axes = self._fit(), self._blocks[-1].nominal_rate_hz, self._blocks[-1].indications.shape[1]
        oldest, end = self._blocks[0].first_index, self._blocks[-1].first_index + self._blocks[-1].n
        edges = np.nan_to_num(clock.index_of(np.array([start_s, stop_s])))
        first, stop = (int(i) for i in np.clip(np.ceil(edges), oldest, end))
        if stop <= first:
            return None
        if stop - first > FASTEST * rate_hz * (stop_s - start_s) + 1:
            return Samples(self._name, first, np.empty((0, axes)), clock, in_time=False)
        times_s = clock.time_of(np.arange(first, stop))
        within = start_s - 1 / rate_hz <= times_s[0] and times_s[-1] <= stop_s + 1 / rate_hz
        in_time = bool(within and (np.diff(times_s) > 0).all())
        held = np.full((stop - first, axes), np.nan)
        saturated, temperatures = False, []
        for block in self._blocks:
            a, b = max(first, block.first_index), min(stop, block.first_index + block.n)
            if a < b:
                if block.temperature_degc is not None:
                    temperatures.append(block.temperature_degc)
                held[a - first : b - first] = block.indications[a - block.first_index : b - block.first_index]
                saturated |= bool(block.flags & BlockFlags.SATURATED)
        degc = float(np.mean(temperatures)) if temperatures else float("nan")
        return Samples(self._name, first, held, clock, saturated, in_time, degc)

    def forget_before(self, time_s: float) -> None:
        """Drop whole blocks that ended before `time_s` (by arrival, which is never early)."""
        while len(self._blocks) > 1 and (self._blocks[0].t_monotonic_ns - self._origin_ns) * 1e-9 < time_s:
            self._blocks.popleft()

    def clear(self) -> None:
        """Drop all samples: they are of another device than the next ones."""
        self._blocks.clear()

    def snapshot(self) -> dict[str, Any]:
        """State for `restore`, bit-exact."""
        return {
            "clock": self._clock.snapshot() if self._clock else None,
            "blocks": [_block_state(block) for block in self._blocks],
            "newest_arrival_s": self.newest_arrival_s,
            "first_sample_s": self.first_sample_s,
        }

    @classmethod
    def restore(cls, name: str, origin_ns: int, state: dict[str, Any], horizon_s: float = HORIZON_S) -> DeviceStream:
        """The stream whose `snapshot` this is."""
        stream = cls(name, origin_ns, horizon_s)
        if state["clock"] is not None:
            stream._clock = ClockModel.restore(state["clock"])
        stream._blocks.extend(_block_of(s) for s in state["blocks"])
        stream.newest_arrival_s = state["newest_arrival_s"]
        stream.first_sample_s = state["first_sample_s"]
        return stream


def _block_state(block: SampleBlock) -> dict[str, Any]:
    state = {name: getattr(block, name) for name in SampleBlock.__slots__}
    return state | {"flags": int(block.flags)}


def _block_of(state: dict[str, Any]) -> SampleBlock:
    return SampleBlock(**(state | {"flags": BlockFlags(state["flags"])}))
