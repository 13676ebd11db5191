"""Reader threads and their queue: a device that will not stay, a queue that is full."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from agent.acquisition.reader import BLOCKS_A_SECOND, QUEUE_S, DeviceReader, EventQueue
from agent.core.events import DeviceChange, Event
from hw.block import BlockFlags, DeviceInfo, Drop, SampleBlock
from hw.sensor import DeviceLost, Options, boot_id, system_clock
from tests.scenarios.processes import wait_until

CAPACITY = QUEUE_S * BLOCKS_A_SECOND


def block(number: int, flags: BlockFlags = BlockFlags.NONE) -> SampleBlock:
    arrival_ns, utc_ns = system_clock()
    burst = np.array([arrival_ns], np.int64), np.array([1], np.int32)
    return SampleBlock("imu", boot_id(), utc_ns, number, 100.0, *burst, np.zeros((1, 3)), flags)


def change(message: str) -> DeviceChange:
    return DeviceChange(device="imu", state="lost", t_monotonic_ns=1, t_utc_ns=1, message=message)


def drained(events: EventQueue) -> list[Event]:
    found: list[Event] = []
    while (event := events.get(0.0)) is not None:
        found.append(event)
    return found


def test_a_full_queue_counts_blocks_lets_changes_in_and_hands_their_flags_on() -> None:
    events = EventQueue(1)
    for number in range(CAPACITY):
        events.put("imu", block(number))
    events.put("imu", change("unplugged"))
    events.put("imu", block(CAPACITY, BlockFlags.RESTART | BlockFlags.SATURATED))
    events.put("imu", block(CAPACITY + 1))
    (gap,) = events.take_gaps()
    assert (gap.device, gap.dropped, gap.unit) == ("imu", 2, "blocks")
    assert events.take_gaps() == []
    *blocks, last = drained(events)
    assert [b.first_index for b in blocks if isinstance(b, SampleBlock)] == list(range(CAPACITY))
    assert last == change("unplugged")
    for number, flags in ((CAPACITY + 2, BlockFlags.RESTART), (CAPACITY + 3, BlockFlags.NONE)):
        events.put("imu", block(number))
        (passed,) = drained(events)
        assert isinstance(passed, SampleBlock)
        assert passed.flags == flags


def test_a_device_that_floods_the_queue_leaves_the_other_its_share() -> None:
    events = EventQueue(2)
    for number in range(10 * CAPACITY):
        events.put("flood", replace(block(number), device="flood"))
    for number in range(CAPACITY):
        events.put("imu", block(number))
    (gap,) = events.take_gaps()
    assert (gap.device, gap.dropped) == ("flood", 9 * CAPACITY)
    assert len(drained(events)) == 2 * CAPACITY
    events.put("flood", replace(block(0), device="flood"))
    assert len(drained(events)) == 1
    assert events.take_gaps() == []


class Flapping:
    """Opens each time, and is gone before it has said anything; with `blocks`, after as many."""

    options_model: ClassVar[type[Options]] = Options

    def __init__(self, blocks: int) -> None:
        self._blocks = blocks
        self._left = 0

    def open(self) -> DeviceInfo:
        self._left = self._blocks
        return DeviceInfo("flapping", "flapping", "", "m/s2", 3, 100.0)

    def read_block(self) -> SampleBlock | None:
        if not self._left:
            raise DeviceLost("port: gone")
        self._left -= 1
        return block(0)

    def take_drops(self) -> list[Drop]:
        return []

    def close(self) -> None:
        pass


def attempts(sensor: Any, losses: int) -> list[int]:
    """The attempt told with each of the first losses."""
    events, seen = EventQueue(1), list[DeviceChange]()

    def lost() -> bool:
        seen.extend(e for e in drained(events) if isinstance(e, DeviceChange) and e.state == "lost")
        return len(seen) >= losses

    reader = DeviceReader("imu", sensor, events)
    reader.start()
    wait_until(lost, 60, "losses")
    reader.stop()
    reader.join()
    return [e.attempt for e in seen[:losses]]


def test_a_device_that_opens_and_says_nothing_is_asked_less_and_less_often() -> None:
    assert attempts(Flapping(0), 4) == [0, 1, 2, 3]


def test_a_device_that_spoke_is_asked_again_at_once() -> None:
    assert attempts(Flapping(1), 4) == [0, 0, 0, 0]
