"""The newest samples of one device, and the clock model that gives the time of each sample."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from calib.model import Array
from calib.signal.samples import Samples
from calib.signal.timing import HORIZON_S, ClockFit, ClockModel
from hw.block import BlockFlags, SampleBlock

# Largest rate of sample numbers, as a multiple of the nominal rate. A faster count is no count of samples but, for
# example, of microseconds; filling the gaps between its numbers would use up the memory.
FASTEST = 10.0


class DeviceStream:
    """Holds the blocks of one device until `forget_before` drops them.

    Times are seconds since the run's origin on the gateway's monotonic clock. After a RESTART (the sample index does
    not continue) the buffer is emptied and the clock model begins again.
    """

    def __init__(self, name: str, origin_ns: int, horizon_s: float = HORIZON_S) -> None:
        """`horizon_s`: the clock model must give times this far back."""
        self._name = name
        self._origin_ns = origin_ns
        self._horizon_s = horizon_s
        self._blocks: deque[SampleBlock] = deque()
        self._clock: ClockModel | None = None
        self._fitted: ClockFit | None = None  # result of the clock model, valid until the next block
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
        """Of the newest block; None before the first block."""
        return self._blocks[-1].nominal_rate_hz if self._blocks else None

    def reaches(self, time_s: float) -> bool:
        """Whether all samples up to `time_s` have arrived."""
        # A sample never arrives before it was taken. If nothing has arrived since `time_s`, no fit of the clock is
        # needed.
        if self.newest_arrival_s is None or self.newest_arrival_s < time_s or not self._blocks:
            return False
        newest = self._blocks[-1]
        return bool(self._fit().time_of(newest.first_index + newest.n - 1) >= time_s)

    def taken_at(self, index: int) -> tuple[float, float]:
        """(time in s since the origin, rate in Hz) of a sample, by the present fit of the clock."""
        clock = self._fit()
        return float(clock.time_of(index)), clock.rate_hz

    def clock(self) -> tuple[ClockFit, Array]:
        """The present fit of the clock, and by how much each of its bursts arrived late (B,) in s. Needs a block."""
        clock = self._fit()
        assert self._clock is not None
        return clock, self._clock.lateness_s(clock)

    def _fit(self) -> ClockFit:
        if self._fitted is None:
            assert self._clock is not None  # there are blocks
            self._fitted = self._clock.result()
        return self._fitted

    def cut(self, start_s: float, stop_s: float) -> Samples | None:
        """All samples with start_s <= t < stop_s by the present fit of the clock; None if there are none."""
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
        """Drop whole blocks that arrived before `time_s`; their samples are older still."""
        while len(self._blocks) > 1 and (self._blocks[0].t_monotonic_ns - self._origin_ns) * 1e-9 < time_s:
            self._blocks.popleft()

    def clear(self) -> None:
        """Drop all samples, because the next ones come from another device."""
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
        """The stream from its `snapshot`."""
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
