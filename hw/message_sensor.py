"""Common part of all drivers whose samples come over a network in messages: polls, blocks, losses."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, DeviceInfo, Drop, SampleBlock
from hw.cutting import Break, Cutter, Stretch
from hw.sensor import GOLDEN, Clock, DeviceLost, Options, system_clock

BLOCK_S, POLL_S = 0.5, 0.02
LONGEST_WAIT_S = 0.6  # for BLOCK_S of samples; a message may come late
EARLIEST_S, LATEST_S = 1.0, 60.0  # a sample may be stamped this much after, or before, the time at which it came
BACK = "samples with times that were passed already"
OUTSIDE = f"samples stamped more than {LATEST_S:g} s before, or {EARLIEST_S:g} s after, they came"

Indications = NDArray[np.int32] | NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Consecutive samples (n, axes), the time of the last one or of its arrival, and what lies before the first one."""

    indications: Indications
    t_monotonic_ns: int
    t_utc_ns: int
    flags: BlockFlags = BlockFlags.NONE
    missing: int = 0


class MessageSensor(ABC):
    """Takes all messages that have come every POLL_S, and makes blocks of half a second of their samples.

    A subclass connects, and turns messages into pieces; `options` must have `rate_hz` and `full_scale`.
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
        limit = options.full_scale or np.inf
        self._cutter = Cutter(name, options.rate_hz, -limit, limit)
        self._opened = False
        self._pieces: list[Piece] = []  # less than a block
        self._waiting = 0  # samples in them
        self._ready: deque[SampleBlock] = deque()
        self._loss: DeviceLost | None = None
        self._drops: Counter[tuple[str, str]] = Counter()
        self._last_ns = 0  # time of the newest sample, CLOCK_MONOTONIC
        self._utc_ns = 0  # UTC less CLOCK_MONOTONIC
        self._phase = 0.0

    @abstractmethod
    def _where(self) -> str:
        """Name of the device and its address, for messages."""

    @abstractmethod
    def _connect(self) -> DeviceInfo:
        """Connect. Raises DeviceLost or ConfigurationError."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Release the connection, also if `_connect` failed half-way. Never raises."""

    @abstractmethod
    def _receive(self) -> Iterator[Piece]:
        """The samples of all messages that have come; waits for none. Raises DeviceLost."""

    def open(self) -> DeviceInfo:
        """Connect. Raises DeviceLost or ConfigurationError."""
        self.close()
        try:
            info = self._connect()
        except BaseException:
            self._disconnect()
            raise
        self._opened = True
        self._loss = None
        self._cutter.flag(BlockFlags.RESTART)
        return info

    def close(self) -> None:
        """Release the connection."""
        if self._opened:
            self._opened = False
            self._disconnect()

    def take_drops(self) -> list[Drop]:
        """What came and became no sample, since the last call."""
        drops = [Drop(count, unit, reason) for (unit, reason), count in self._drops.items()]  # type: ignore[arg-type]
        self._drops.clear()
        return drops

    def read_block(self) -> SampleBlock | None:
        """The next block, or None if no sample came. Raises DeviceLost."""
        if not self._ready and self._loss is None:
            if not self._opened:
                raise DeviceLost(f"{self._where()} is not connected")
            self._gather()
        if self._ready:
            return self._ready.popleft()
        if self._loss is not None:
            raise self._loss
        return None

    def _gather(self) -> None:
        """Take messages until they hold BLOCK_S of samples, LONGEST_WAIT_S is over, or the device is lost."""
        end_ns = self._clock()[0] + round(LONGEST_WAIT_S * 1e9)
        try:
            while not self._ready:
                if self._clock()[0] >= end_ns:
                    self._finish()
                    return
                self._phase = (self._phase + GOLDEN) % 1.0  # avoids a beat between polls and messages
                self._sleep(POLL_S * (0.5 + self._phase))
                for piece in self._receive():
                    if self._follows(piece):
                        self._pieces.append(piece)
                        self._waiting += len(piece.indications)
                        if self._waiting >= BLOCK_S * self._options.rate_hz:
                            self._finish()
        except DeviceLost as error:
            self._loss = error  # raised after all earlier samples have been returned
            self._finish()

    def _is_timely(self, t_monotonic_ns: int) -> bool:
        """Whether the last sample of a message that came now may have been taken at this time."""
        return -EARLIEST_S * 1e9 <= self._clock()[0] - t_monotonic_ns <= LATEST_S * 1e9

    def _follow_utc(self) -> bool:
        """Follow the UTC of this computer. True where it stepped: stamps before and after cannot be compared."""
        now_ns, utc_ns = self._clock()
        moved, self._utc_ns = utc_ns - now_ns - self._utc_ns, utc_ns - now_ns
        return abs(moved) > 0.5e9 / float(self._options.rate_hz)

    def _follows(self, piece: Piece) -> bool:
        """Whether time goes on; if not, the piece is counted as lost and the next block carries RESTART."""
        if piece.t_monotonic_ns >= self._last_ns:
            self._last_ns = piece.t_monotonic_ns
            return True
        self._drops["samples", BACK] += len(piece.indications)
        self._cutter.flag(BlockFlags.RESTART)
        return False

    def _finish(self) -> None:
        """Make blocks of the pieces that wait."""
        pieces, self._pieces, self._waiting = self._pieces, [], 0
        if not pieces:
            return
        count = np.cumsum([len(piece.indications) for piece in pieces])
        starts = [0, *count[:-1].tolist()]
        breaks = [
            Break(at, piece.flags, piece.missing) for at, piece in zip(starts, pieces, strict=True) if piece.flags
        ]
        arrivals_ns = np.array([piece.t_monotonic_ns for piece in pieces], np.int64)
        indications = np.ascontiguousarray(np.concatenate([piece.indications for piece in pieces]))
        newest = np.append(np.diff(arrivals_ns) > 0, True)  # messages that came together are one burst
        stretch = Stretch(indications, arrivals_ns[newest], count[newest], pieces[-1].t_utc_ns)
        self._ready.extend(self._cutter.cut(stretch, breaks))
