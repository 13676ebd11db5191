"""Common part of all drivers whose samples wait in the buffer of a library: polls, bursts, losses."""

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
BUFFER_S = 1.0  # length of the buffer that a driver asks its library for: fifty polls
OVERFLOW = "input overflow"

Indications = NDArray[np.int32] | NDArray[np.float64]
Read = tuple[int, int, Indications]
"""Arrival (CLOCK_MONOTONIC) and UTC, both in ns, and the samples."""


class BufferedSensor(ABC):
    """Reads all waiting samples every POLL_S. Their arrival is the time just before the read.

    If the buffer overflows, it is not known where among the waiting samples the lost ones were. All waiting samples are
    then discarded and the next block carries RESTART and OVERRUN. A subclass finds, starts and reads its device;
    `options` must have `rate_hz`.
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
        self._cutter = Cutter(name, np.nan)  # the rate is known after `open`
        self._opened = False
        self._ready: deque[SampleBlock] = deque()
        self._loss: DeviceLost | None = None
        self._dropped = 0
        self._phase = 0.0

    @abstractmethod
    def _where(self) -> str:
        """Name of the device and its port, for messages."""

    @abstractmethod
    def _start(self) -> DeviceInfo:
        """Find the device, set it up and start the measurement.

        Raises DeviceLost, ConfigurationError or IdentityError.
        """

    @abstractmethod
    def _stop(self) -> None:
        """Release the device, also if `_start` found it but could not start it. Never raises."""

    @abstractmethod
    def _take(self) -> tuple[Indications, bool]:
        """Return the waiting samples (n, axes), and whether samples were lost since the last call.

        After a loss the measurement must run again when this method returns. Raises DeviceLost.
        """

    def _ends(self, info: DeviceInfo) -> tuple[float, float]:  # noqa: ARG002 - not every device needs it
        """Lowest and highest indication of the range, in the unit of the indications."""
        return -np.inf, np.inf

    def _temperature(self) -> tuple[int | None, float | None]:
        """Raw value and degC at the end of a block; None where the device has no thermometer."""
        return None, None

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
        """The samples that were discarded because the buffer overflowed, since the last call."""
        dropped, self._dropped = self._dropped, 0
        return [Drop(dropped, "samples", OVERFLOW)] if dropped else []

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
        """Read samples for BLOCK_S, or until samples or the device are lost."""
        reads: list[Read] = []
        end_ns = self._clock()[0] + round(BLOCK_S * 1e9)
        try:
            while self._clock()[0] < end_ns and not self._ready:
                self._phase = (self._phase + GOLDEN) % 1.0  # avoids a beat between polls and sample clock
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
            self._loss = error  # raised after all earlier samples have been returned
        self._finish(reads)

    def _finish(self, reads: list[Read]) -> None:
        """Make blocks of the samples in `reads`."""
        if not reads:
            return
        arrivals_ns, utc_ns, samples = zip(*reads, strict=True)
        count = np.cumsum([len(part) for part in samples])
        indications = np.ascontiguousarray(np.concatenate(samples))
        stretch = Stretch(indications, np.array(arrivals_ns), count, utc_ns[-1], *self._temperature())
        self._ready.extend(self._cutter.cut(stretch))
