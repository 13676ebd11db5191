"""Tests that every driver must pass, on a device that numbers its samples. Subclass `SensorContract` with a rig."""

from __future__ import annotations

import itertools
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from hw.block import BlockFlags, DeviceInfo, SampleBlock
from hw.promises import BlockCheck, block_fault, checked_drops, checked_info
from hw.sensor import DeviceLost, Options, Sensor

EPOCH_NS = 1_700_000_000_000_000_000


class Rig(ABC):
    """A driver on a simulated device at `rate_hz`. Both use one simulated clock, which only `sleep` moves.

    The indications of sample k contain the number k (see `number`). Sample k exists from time k / rate_hz on.
    """

    sensor: Sensor
    rate_hz = 1000.0
    t_s = 0.0
    silent_from: int | None = None

    def clock(self) -> tuple[int, int]:
        ns = round(self.t_s * 1e9)
        return ns, EPOCH_NS + ns

    def sleep(self, seconds: float) -> None:
        self.t_s += seconds

    def due(self, t_s: float) -> int:
        """Number of samples that the device has made until `t_s`."""
        due = int(np.floor(t_s * self.rate_hz + 1e-6)) + 1
        return due if self.silent_from is None else min(due, self.silent_from)

    def silence(self) -> None:
        """The device makes no more samples from now on."""
        self.silent_from = self.due(self.t_s)

    @abstractmethod
    def build_elsewhere(self) -> Sensor:
        """A driver whose port does not exist."""

    @abstractmethod
    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        """Sample numbers (n,) of the indications (n, axes); fails if the axes of a row belong to different samples."""

    @abstractmethod
    def saturate(self, first: int, last: int) -> None:
        """Put samples `first` to `last` at the end of the range."""

    @abstractmethod
    def lose(self) -> None:
        """Remove some of the samples that wait to be read, in the middle of them."""

    @abstractmethod
    def unplug(self) -> None: ...

    @abstractmethod
    def replug(self) -> None: ...

    @abstractmethod
    def close(self) -> None: ...

    def open(self) -> DeviceInfo:
        """Open the driver's port."""
        return self.sensor.open()

    def blocks(self, seconds: float) -> Iterator[SampleBlock]:
        """Read blocks until they hold at least `seconds` of samples."""
        samples = seconds * self.rate_hz
        while samples > 0:
            block = self.sensor.read_block()
            assert block is not None, "the device fell silent"
            samples -= block.n
            yield block


def check_shape(block: SampleBlock, axes: int) -> None:
    """Check what a block promises by itself: shapes, types, order."""
    assert block_fault(block) == ""
    assert block.indications.shape == (block.n, axes)
    assert block.burst_count[0] > 0
    assert (np.diff(block.burst_count) > 0).all()
    assert (np.diff(block.burst_t_monotonic_ns) > 0).all()
    assert block.t_utc_ns - EPOCH_NS == block.t_monotonic_ns
    assert len(block.boot_id) == 36


class SensorContract(ABC):
    """What every driver must do. `samples` are read without a pause; a million, unless the environment says fewer."""

    samples = int(os.environ.get("FIELDCAL_CONTRACT_SAMPLES", "1000000"))

    @pytest.fixture
    @abstractmethod
    def rig(self) -> Iterator[Rig]: ...

    def test_the_driver_is_a_sensor_with_options(self, rig: Rig) -> None:
        assert isinstance(rig.sensor, Sensor)
        assert issubclass(rig.sensor.options_model, Options)

    def test_nothing_there(self, rig: Rig) -> None:
        sensor = rig.build_elsewhere()
        with pytest.raises(DeviceLost, match="/"):
            sensor.open()
        with pytest.raises(DeviceLost):
            sensor.read_block()
        sensor.close()

    def test_close_is_harmless_at_any_time(self, rig: Rig) -> None:
        rig.sensor.close()
        rig.open()
        rig.sensor.close()
        rig.sensor.close()
        with pytest.raises(DeviceLost):
            rig.sensor.read_block()
        rig.open()
        assert next(rig.blocks(0.1)).n > 0

    def test_blocks_of_half_a_second(self, rig: Rig) -> None:
        opened = rig.clock()
        info = checked_info(rig.open())
        assert info.nominal_rate_hz == rig.rate_hz
        blocks = list(rig.blocks(5.0))
        assert blocks[0].flags == BlockFlags.RESTART
        assert {block.flags for block in blocks[1:]} == {BlockFlags.NONE}
        index = blocks[0].first_index
        agent = BlockCheck(blocks[0].device, info, opened, rig.clock)
        for block in blocks:
            assert np.array_equal(agent.taken(block).indications, block.indications)
            check_shape(block, info.axes)
            assert block.first_index == index
            assert 0.4 * rig.rate_hz < block.n < 0.6 * rig.rate_hz
            index += block.n
        assert checked_drops(rig.sensor.take_drops()) == []

    def test_arrivals_are_late_by_less_than_a_sample(self, rig: Rig) -> None:
        # The simulated reads take no time: the burst must hold exactly the samples that existed at its arrival.
        rig.open()
        for block in rig.blocks(2.0):
            numbers = rig.number(block.indications)
            last_made = [rig.due(t_ns * 1e-9) - 1 for t_ns in block.burst_t_monotonic_ns.tolist()]
            assert numbers[block.burst_count - 1].tolist() == last_made

    def test_polls_do_not_beat_with_the_sample_clock(self, rig: Rig) -> None:
        # The delay from sample to arrival must be spread evenly over a sample period in any second, although the ratio
        # of the two clocks is rational.
        rig.open()
        arrivals_ns = np.concatenate([block.burst_t_monotonic_ns for block in rig.blocks(1.0)])
        lateness = arrivals_ns * 1e-9 * rig.rate_hz % 1.0
        share, _ = np.histogram(lateness, bins=4, range=(0.0, 1.0))
        assert share.min() >= 0.15 * len(lateness)

    def test_unplugged_and_back(self, rig: Rig) -> None:
        rig.open()
        before = list(rig.blocks(1.2))
        rig.unplug()
        with pytest.raises(DeviceLost, match="/"):
            before.extend(rig.blocks(2.0))
        with pytest.raises(DeviceLost):
            rig.open()
        rig.sleep(1.0)
        rig.replug()
        rig.open()
        after = next(rig.blocks(0.1))
        assert after.flags == BlockFlags.RESTART
        assert after.first_index == before[-1].first_index + before[-1].n
        check_shape(after, after.indications.shape[1])

    def test_what_came_before_the_loss_is_returned_first(self, rig: Rig) -> None:
        rig.open()
        list(rig.blocks(0.6))
        sleep = rig.sleep
        start_s = rig.t_s

        def unplugged_underway(seconds: float) -> None:
            sleep(seconds)
            if rig.t_s > start_s + 0.2:
                rig.unplug()

        rig.sleep = unplugged_underway  # type: ignore[method-assign]
        block = rig.sensor.read_block()
        assert block is not None
        assert 0.15 * rig.rate_hz < block.n < 0.25 * rig.rate_hz
        with pytest.raises(DeviceLost):
            rig.sensor.read_block()

    def test_silence_is_none(self, rig: Rig) -> None:
        rig.open()
        list(rig.blocks(0.6))
        rig.silence()
        assert rig.sensor.read_block() is None or rig.sensor.read_block() is None
        rig.silent_from = None
        assert next(rig.blocks(0.1)).n > 0

    def test_saturated_blocks_say_so(self, rig: Rig) -> None:
        there = round(1.7 * rig.rate_hz)
        rig.saturate(there, there)
        rig.open()
        marked = [block for block in rig.blocks(4.0) if block.flags & BlockFlags.SATURATED]
        assert len(marked) == 1
        assert there in rig.number(marked[0].indications)

    def test_a_loss_is_marked_where_it_is(self, rig: Rig) -> None:
        # Neighbours in a block must be neighbours in the device; otherwise a reader computes wrong times.
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.sleep(0.02)
        rig.lose()
        blocks = [before, *rig.blocks(1.5)]
        for block in blocks:
            assert (np.diff(rig.number(block.indications)) == 1).all()
        joints = [
            int(rig.number(b.indications)[0] - rig.number(a.indications)[-1]) for a, b in itertools.pairwise(blocks)
        ]
        flags = [block.flags & (BlockFlags.GAP | BlockFlags.RESTART) for block in blocks[1:]]
        assert [joint != 1 for joint in joints] == [bool(flag) for flag in flags]
        assert sum(joint != 1 for joint in joints) == 1

    @pytest.mark.parametrize("seconds", [0.1, 3.0])
    def test_a_late_reader_is_told(self, rig: Rig, seconds: float) -> None:
        # Devices lose samples in different places (FIFO of the device, buffer of the kernel), but every driver must
        # report it.
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.sleep(seconds)
        number = int(rig.number(before.indications)[-1])
        for block in rig.blocks(1.0):
            numbers = rig.number(block.indications)
            assert (np.diff(numbers) == 1).all()
            if numbers[0] != number + 1:
                assert block.flags & (BlockFlags.GAP | BlockFlags.RESTART)
            number = int(numbers[-1])

    def test_no_sample_is_lost_doubled_or_shifted(self, rig: Rig) -> None:
        rig.open()
        blocks = rig.blocks(self.samples / rig.rate_hz)
        block = next(blocks)
        assert block.first_index == 0
        next_number = int(rig.number(block.indications)[0])
        index = 0
        while True:
            assert block.first_index == index
            assert np.array_equal(rig.number(block.indications), np.arange(next_number, next_number + block.n))
            index += block.n
            next_number += block.n
            if index >= self.samples:
                break
            block = next(blocks)
            assert block.flags == BlockFlags.NONE
        assert rig.sensor.take_drops() == []
