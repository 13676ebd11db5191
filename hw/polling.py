"""The one loop of every driver that polls: open, poll for half a second, make blocks, tell a loss after all samples."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, ClassVar, Literal

from hw.block import DeviceInfo, Drop, SampleBlock
from hw.sensor import GOLDEN, Clock, DeviceLost, Options, system_clock

BLOCK_S = 0.5  # s of samples in a block

Unit = Literal["samples", "lines", "bytes"]


class PollingSensor(ABC):
    """Polls a device until a block is complete. A subclass overrides what is its own.

    `_start` and `_stop` open and release the device, `_wait` pauses until the next poll, `_poll_once` reads what waits,
    and `_finish` makes blocks of what was read and appends them to `_ready`.
    """

    options_model: ClassVar[type[Options]]
    poll_s: ClassVar[float] = 0.02  # s between polls
    block_s: ClassVar[float] = BLOCK_S  # longest time of polling for a block, s

    def __init__(
        self,
        name: str,  # noqa: ARG002 - a subclass numbers the samples of the device under this name
        options: Any,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options
        self._clock = clock
        self._sleep = sleep
        self._opened = False
        self._ready: deque[SampleBlock] = deque()
        self._loss: DeviceLost | None = None
        self._dropped: Counter[tuple[Unit, str]] = Counter()  # number by unit and reason
        self._rate_hz = math.nan  # nominal rate of the open device
        self._phase = 0.0
        self._end_ns = 0  # CLOCK_MONOTONIC at which the polling for a block ends

    @abstractmethod
    def _where(self) -> str:
        """Name of the device and its port, for messages."""

    @abstractmethod
    def _start(self) -> DeviceInfo:
        """Find the device, set it up and start it. The next block must carry RESTART.

        Raises DeviceLost, ConfigurationError or IdentityError.
        """

    @abstractmethod
    def _stop(self) -> None:
        """Release the device, also where `_start` failed half-way. Never raises."""

    @abstractmethod
    def _poll_once(self) -> bool:
        """Read what waits; False where no more will come in the time of this block. Raises DeviceLost."""

    @abstractmethod
    def _finish(self) -> None:
        """Make blocks of all that was read. `_loss` tells where the device was lost meanwhile. May raise DeviceLost."""

    def open(self) -> DeviceInfo:
        """Find the device, set it up and start it. Raises DeviceLost, ConfigurationError or IdentityError."""
        self.close()
        try:
            info = self._start()
        except BaseException:
            self._stop()
            raise
        self._opened = True
        self._loss = None
        self._rate_hz = info.nominal_rate_hz
        return info

    def close(self) -> None:
        """Release the device."""
        if self._opened:
            self._opened = False
            self._stop()

    def take_drops(self) -> list[Drop]:
        """Data since the last call that became no sample, by unit and reason."""
        drops = [Drop(count, unit, reason) for (unit, reason), count in self._dropped.items() if count]
        self._dropped.clear()
        return drops

    def read_block(self) -> SampleBlock | None:
        """The next block, or None if no sample came. Raises DeviceLost."""
        if not self._ready and self._loss is None:
            if not self._opened:
                raise DeviceLost(f"{self._where()} is not open")
            self._gather()
        if self._ready:
            return self._ready.popleft()
        if self._loss is not None:
            raise self._loss
        return None

    def _gather(self) -> None:
        """Poll until a block is ready, the time of a block is over, or the device is lost."""
        self._extend()
        try:
            while not self._ready and self._clock()[0] < self._end_ns:
                self._wait()
                if not self._poll_once():
                    break
            if not self._ready:
                self._finish()
        except DeviceLost as loss:
            self._loss = loss  # raised after all earlier samples have been returned
            self._finish()

    def _extend(self) -> None:
        """Begin the time of a block now."""
        self._end_ns = self._clock()[0] + round(self.block_s * 1e9)

    def _wait(self) -> None:
        """Sleep until the next poll: `poll_s`, and a part of a sample period so that polls and samples do not beat."""
        self._sleep(self.poll_s + self._next_phase() / self._rate_hz)

    def _next_phase(self) -> float:
        """Part of a sample period by which this poll is late.

        The parts follow the golden ratio, so that the arrivals of each second cover the whole sample period.
        """
        self._phase = (self._phase + GOLDEN) % 1.0
        return self._phase
