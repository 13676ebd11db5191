"""What all drivers have in common whose samples wait in a library's buffer: polls, bursts, losses."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, DeviceInfo, Drop, SampleBlock
from hw.cutting import Cutter, Stretch
from hw.sensor import GOLDEN, Clock, DeviceLost, Options, system_clock

BLOCK_S, POLL_S = 0.5, 0.02
BUFFER_S = 1.0  # what a driver asks its library to keep: fifty polls
OVERFLOW = "input overflow"

Indications = NDArray[np.int32] | NDArray[np.float64]
Read = tuple[int, int, Indications]
"""Arrival and UTC in ns, and the samples."""


class BufferedSensor(ABC):
    """Takes what waits every POLL_S, stamped with the time just before it is asked for.

    What an overflow lost lies somewhere in what was waiting: all of that is thrown away, and the next sample starts
    anew. A subclass finds, starts and reads its device; `options` must have `rate_hz`.
    """

    options_model: ClassVar[type[Options]]

    def __init__(
        self,
        name: str,
        options: Any,
        *,
        clock: Clock = system_clock,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options
        self._clock = clock
        self._sleep = sleep
        self._cutter = Cutter(name, np.nan)  # the rate is known once it is open
        self._opened = False
        self._ready: deque[SampleBlock] = deque()
        self._loss: DeviceLost | None = None
        self._dropped = 0
        self._phase = 0.0

    @abstractmethod
    def _where(self) -> str:
        """The way to the device, for messages."""

    @abstractmethod
    def _start(self) -> DeviceInfo:
        """Find the device, set it, let it measure. Raises DeviceLost, ConfigurationError or IdentityError."""

    @abstractmethod
    def _stop(self) -> None:
        """Release the device, also one that `_start` found but could not start; never raises."""

    @abstractmethod
    def _take(self) -> tuple[Indications, bool]:
        """What waits (n, axes), and whether samples were lost since the last call; it measures on then.

        Raises DeviceLost.
        """

    def _ends(self, info: DeviceInfo) -> tuple[float, float]:  # noqa: ARG002 - not every device says
        """Ends of the range, in the indications' unit."""
        return -np.inf, np.inf

    def _temperature(self) -> tuple[int | None, float | None]:
        """Raw and degC at the end of a block."""
        return None, None

    def open(self) -> DeviceInfo:
        """Find it, set it, start it. Raises DeviceLost, ConfigurationError or IdentityError."""
        self.close()
        try:
            info = self._start()
        except BaseException:
            self._stop()
            raise
        self._opened = True
        self._loss = None
        self._cutter.nominal_rate_hz = info.nominal_rate_hz
        self._cutter.lowest, self._cutter.highest = self._ends(info)
        self._cutter.flag(BlockFlags.RESTART)
        return info

    def close(self) -> None:
        """Release the device."""
        if self._opened:
            self._opened = False
            self._stop()

    def take_drops(self) -> list[Drop]:
        """What waited when the buffer ran over."""
        dropped, self._dropped = self._dropped, 0
        return [Drop(dropped, "samples", OVERFLOW)] if dropped else []

    def read_block(self) -> SampleBlock | None:
        """The next block, or None. Raises DeviceLost."""
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
        """Take for BLOCK_S; a loss, of samples or of the device, ends it earlier."""
        reads: list[Read] = []
        end_ns = self._clock()[0] + round(BLOCK_S * 1e9)
        try:
            while self._clock()[0] < end_ns and not self._ready:
                self._phase = (self._phase + GOLDEN) % 1.0  # so that poll and sample clock do not beat
                self._sleep(POLL_S + self._phase / self._cutter.nominal_rate_hz)
                now_ns, utc_ns = self._clock()
                samples, overflowed = self._take()
                if overflowed:
                    self._dropped += len(samples)
                    self._finish(reads)
                    self._cutter.flag(BlockFlags.RESTART | BlockFlags.OVERRUN)
                    reads = []
                    end_ns = now_ns + round(BLOCK_S * 1e9)
                elif len(samples):
                    reads.append((now_ns, utc_ns, samples))
        except DeviceLost as error:
            self._loss = error  # raised once all before it is returned
        self._finish(reads)

    def _finish(self, reads: list[Read]) -> None:
        """Make blocks of what was read."""
        if not reads:
            return
        arrivals_ns, utc_ns, samples = zip(*reads, strict=True)
        count = np.cumsum([len(part) for part in samples])
        indications = np.ascontiguousarray(np.concatenate(samples))
        stretch = Stretch(indications, np.array(arrivals_ns), count, utc_ns[-1], *self._temperature())
        self._ready.extend(self._cutter.cut(stretch))
