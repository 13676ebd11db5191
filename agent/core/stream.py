"""The newest samples of one device, and the clock model that gives the time of each sample."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from calib.model import Array
from calib.signal.samples import Samples
from calib.signal.timing import HORIZON_S, ClockFit, ClockModel
from hw.block import LARGEST, BlockFlags, SampleBlock

# Largest rate of sample numbers, as a multiple of the nominal rate. A faster count is no count of samples but, for
# example, of microseconds; filling the gaps between its numbers would use up the memory.
FASTEST = 10.0
# The most places for samples, as a multiple of the samples that are there, and beyond: a few samples with large gaps
# between their numbers would use up the memory too.
SPARSEST, SPARSE = 10, 1_000_000


# Samples of which nobody can count how many are missing before them: they get a clock of their own.
UNCOUNTED = int(BlockFlags.RESTART | BlockFlags.OVERRUN)
SATURATED = int(BlockFlags.SATURATED)  # as integers: flags of an enumeration take 15 times as long


class BlockRun:
    """Blocks whose samples are counted on from each other, with the clock of these samples."""

    def __init__(self, clock: ClockModel, number: int = 0) -> None:
        """`number` counts the runs of a device."""
        self.number = number
        self.blocks: deque[SampleBlock] = deque()
        self.model = clock
        self.sound = True  # no block so far had a number that is too large to compute with
        self._fitted: ClockFit | None = None  # the clock model's result, until the next block
        self._in_time = True

    def update(self, block: SampleBlock, arrivals_s: Array) -> None:
        """Take the next block, whose bursts arrived at these times (B,)."""
        self.model.update(block.first_index + block.burst_count.astype(np.int64) - 1, arrivals_s)
        self.blocks.append(block)
        self.sound = self.sound and _is_sound(block)
        self._fitted = None

    @property
    def in_time(self) -> bool:
        """Whether the sample numbers and arrivals make a clock at all."""
        self.clock()
        return self._in_time

    def clock(self) -> ClockFit:
        """The clock as it is now. Where the sample numbers make none, one that counts back from the newest arrival."""
        if self._fitted is None:
            with np.errstate(all="ignore"):
                fitted = self._result()
            self._in_time = fitted is not None
            self._fitted = fitted or self.model.nominal()
        return self._fitted

    def _result(self) -> ClockFit | None:
        try:
            fitted = self.model.result()
        except (np.linalg.LinAlgError, ZeroDivisionError):  # numbers that jump at will: 0, 1, 0, 1, ...
            return None
        return fitted if np.isfinite([*fitted.knot_time_s, *fitted.knot_period_s]).all() else None

    @property
    def span_s(self) -> tuple[float, float]:
        """From the oldest sample that is held to one period after the newest."""
        oldest, newest = self.blocks[0], self.blocks[-1]
        start_s, stop_s = self.clock().time_of([oldest.first_index, newest.first_index + newest.n]).tolist()
        return start_s, stop_s

    def snapshot(self) -> dict[str, Any]:
        """State for `restore`, bit-exact."""
        return {
            "number": self.number,
            "clock": self.model.snapshot(),
            "blocks": [_block_state(block) for block in self.blocks],
        }

    @classmethod
    def restore(cls, state: Mapping[str, Any]) -> BlockRun:
        """The run whose `snapshot` this is."""
        run = cls(ClockModel.restore(state["clock"]), state["number"])
        run.blocks.extend(_block_of(s) for s in state["blocks"])
        run.sound = all(_is_sound(block) for block in run.blocks)
        return run


class DeviceStream:
    """Holds the blocks of one device until `forget_before` drops them.

    Times are seconds since the run's origin on the gateway's monotonic clock. After a RESTART or an OVERRUN (nobody can
    count the samples on) a new run begins, with a clock of its own; runs before are kept as long as they are needed.
    """

    def __init__(self, name: str, origin_ns: int, horizon_s: float = HORIZON_S) -> None:
        """`horizon_s`: the clock model must give times this far back."""
        self._name = name
        self.origin_ns = origin_ns
        self._horizon_s = horizon_s
        self._runs: list[BlockRun] = []  # in order of time; of all but the newest there are blocks
        self.newest_arrival_s: float | None = None
        self.first_sample_s: float | None = None

    def update(self, block: SampleBlock) -> None:
        """Take the next block."""
        arrivals_s: Array = (block.burst_t_monotonic_ns - self.origin_ns) * np.float64(1e-9)
        first_arrival_s = float(arrivals_s[0])
        if self.first_sample_s is None:
            self.first_sample_s = first_arrival_s - int(block.burst_count[0]) / block.nominal_rate_hz
        if not self._runs or int(block.flags) & UNCOUNTED:
            number = self._runs[-1].number + 1 if self._runs else 0
            self._runs = [run for run in self._runs if run.blocks]
            self._runs.append(BlockRun(ClockModel(block.nominal_rate_hz, self._horizon_s), number))
        self._runs[-1].update(block, arrivals_s)
        self.newest_arrival_s = float(arrivals_s[-1])

    @property
    def nominal_rate_hz(self) -> float | None:
        """As the newest block tells it; None before any."""
        return self._runs[-1].blocks[-1].nominal_rate_hz if self._holds else None

    @property
    def sound(self) -> bool:
        """Whether no sample and no temperature is too large to compute with."""
        return all(run.sound for run in self._runs)

    @property
    def _holds(self) -> bool:
        return bool(self._runs and self._runs[-1].blocks)

    def reaches(self, time_s: float) -> bool:
        """Whether samples up to `time_s` are there."""
        # A sample never arrives before it was taken: as long as nothing arrived since, the clock need not be asked.
        if self.newest_arrival_s is None or self.newest_arrival_s < time_s or not self._holds:
            return False
        newest = self._runs[-1].blocks[-1]
        return bool(self._runs[-1].clock().time_of(newest.first_index + newest.n - 1) >= time_s)

    def taken_at(self, index: int, *, before_restart: bool = False) -> tuple[float, float]:
        """(time in s since the origin, rate in Hz) of a sample, by the clock as it is now.

        `before_restart`: a sample of the run before the newest one.
        """
        clock = self._runs[-2 if before_restart and len(self._runs) > 1 else -1].clock()
        return float(clock.time_of(index)), clock.rate_hz

    def clock(self) -> tuple[ClockFit, Array] | None:
        """The clock as it is now, and how late each burst behind it arrived (B,) in s; None where there is none.

        There must be a block.
        """
        if not self._runs[-1].in_time:
            return None
        clock = self._runs[-1].clock()
        return clock, self._runs[-1].model.lateness_s(clock)

    def breaks(self, start_s: float, stop_s: float) -> list[tuple[float, float]]:
        """Between `start_s` and `stop_s`: when a run ended, and when the next one began."""
        spans = [run.span_s for run in self._runs if run.blocks]
        found = [(ended, max(ended, began)) for (_, ended), (began, _) in itertools.pairwise(spans)]
        return [(ended, began) for ended, began in found if ended < stop_s and began > start_s]

    def run_number(self, start_s: float, stop_s: float) -> int | None:
        """The number of the run that `cut` takes; None where there are no samples."""
        run = self._run_of(start_s, stop_s)
        return None if run is None else run.number

    def missing(self, start_s: float, stop_s: float) -> int:
        """How many samples are known to be missing in holes that reach between these times."""
        count = 0
        for run in self._runs:
            for before, after in itertools.pairwise(run.blocks):
                hole = (before.first_index + before.n, after.first_index)
                if hole[1] > hole[0] and run.in_time:
                    began_s, ended_s = run.clock().time_of(hole).tolist()
                    count += hole[1] - hole[0] if began_s < stop_s and ended_s > start_s else 0
        return count

    def late(self, start_s: float, stop_s: float) -> int:
        """How many samples between these times arrived so late that the clock does not follow from them."""
        count = 0
        for run in self._runs:
            if run.blocks and run.in_time:
                within = run.clock().index_of(np.array([start_s, stop_s]))
                first, last = run.clock().late.T
                count += int(np.sum((np.minimum(last, within[1]) - np.maximum(first, within[0]) + 1.0).clip(0.0)))
        return count

    def cut(self, start_s: float, stop_s: float) -> Samples | None:
        """All samples with start_s <= t < stop_s by the clock model as it is now; None if there are none.

        They are of one run, the one that has most of this time.
        """
        run = self._run_of(start_s, stop_s)
        if run is None:
            return None
        blocks, clock = run.blocks, run.clock()
        rate_hz, axes = blocks[-1].nominal_rate_hz, blocks[-1].indications.shape[1]
        if not run.in_time:
            return Samples(self._name, 0, np.empty((0, axes)), clock, in_time=False)
        oldest, end = blocks[0].first_index, blocks[-1].first_index + blocks[-1].n
        edges = np.nan_to_num(clock.index_of(np.array([start_s, stop_s])))
        first, stop = (int(i) for i in np.clip(np.ceil(edges), oldest, end))
        if stop <= first:
            return None
        count = sum(block.n for block in blocks)
        if stop - first > min(FASTEST * rate_hz * (stop_s - start_s) + 1, SPARSEST * count + SPARSE):
            return Samples(self._name, first, np.empty((0, axes)), clock, in_time=False)
        held = np.full((axes, stop - first), np.nan)  # the samples of an axis lie side by side
        saturated, temperatures = False, []
        for block in blocks:
            a, b = max(first, block.first_index), min(stop, block.first_index + block.n)
            if a < b:
                if block.temperature_degc is not None:
                    temperatures.append(block.temperature_degc)
                held[:, a - first : b - first] = block.indications[a - block.first_index : b - block.first_index].T
                saturated |= bool(int(block.flags) & SATURATED)
        degc = float(np.mean(temperatures)) if temperatures else float("nan")
        found = Samples(self._name, first, held.T, clock, saturated, temperature_degc=degc)
        times_s = found.time_s
        within = start_s - 1 / rate_hz <= times_s[0] and times_s[-1] <= stop_s + 1 / rate_hz
        return found if within and (times_s[1:] > times_s[:-1]).all() else replace(found, in_time=False)

    def _run_of(self, start_s: float, stop_s: float) -> BlockRun | None:
        held = [run for run in self._runs if run.blocks]
        if len(held) < 2:
            return held[0] if held else None
        spans = [run.span_s for run in held]
        within_s = [min(stop, stop_s) - max(start, start_s) for start, stop in spans]
        return held[int(np.argmax(within_s))]

    def forget_before(self, time_s: float) -> None:
        """Drop whole blocks that ended before `time_s` (by arrival, which is never early)."""
        newest = self._runs[-1:]
        for run in self._runs:
            least = 1 if run is newest[0] else 0
            while len(run.blocks) > least and (run.blocks[0].t_monotonic_ns - self.origin_ns) * 1e-9 < time_s:
                run.blocks.popleft()
        self._runs = [run for run in self._runs[:-1] if run.blocks] + newest

    def look_back(self, horizon_s: float) -> None:
        """The clock models must give times this far back from now on."""
        self._horizon_s = horizon_s
        for run in self._runs:
            run.model.horizon_s = horizon_s

    def clear(self) -> None:
        """Drop all samples: they are of another device than the next ones."""
        self._runs = self._runs[-1:]
        for run in self._runs:
            run.blocks.clear()

    def snapshot(self) -> dict[str, Any]:
        """State for `restore`, bit-exact."""
        return {
            "runs": [run.snapshot() for run in self._runs],
            "newest_arrival_s": self.newest_arrival_s,
            "first_sample_s": self.first_sample_s,
        }

    @classmethod
    def restore(cls, name: str, origin_ns: int, state: dict[str, Any], horizon_s: float = HORIZON_S) -> DeviceStream:
        """The stream from its `snapshot`."""
        stream = cls(name, origin_ns, horizon_s)
        stream._runs = [BlockRun.restore(run) for run in state["runs"]]
        stream.newest_arrival_s = state["newest_arrival_s"]
        stream.first_sample_s = state["first_sample_s"]
        return stream


def _is_sound(block: SampleBlock) -> bool:
    values, degc = block.indications, block.temperature_degc
    counts = values.dtype == np.int32
    return (counts or not (np.abs(values) > LARGEST).any()) and not (degc is not None and abs(degc) > LARGEST)


def _block_state(block: SampleBlock) -> dict[str, Any]:
    state = {name: getattr(block, name) for name in SampleBlock.__slots__}
    return state | {"flags": int(block.flags)}


def _block_of(state: dict[str, Any]) -> SampleBlock:
    return SampleBlock(**(state | {"flags": BlockFlags(state["flags"])}))
