"""Common part of all drivers whose samples come over a network in messages."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, DeviceInfo
from hw.cutting import Break, Cutter, Stretch
from hw.polling import BLOCK_S, PollingSensor

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


class MessageSensor(PollingSensor):
    """Takes all messages that have come at each poll, and makes blocks of half a second of their samples.

    A subclass connects, and turns messages into pieces; `options` must have `rate_hz` and `full_scale`.
    """

    block_s = 0.6  # for BLOCK_S of samples; a message may come late

    def __init__(self, name: str, options: Any, **timing: Any) -> None:
        super().__init__(name, options, **timing)
        limit = options.full_scale or np.inf
        self._cutter = Cutter(name, options.rate_hz, -limit, limit)
        self._pieces: list[Piece] = []  # less than a block
        self._waiting = 0  # samples in them
        self._last_ns = 0  # time of the newest sample, CLOCK_MONOTONIC
        self._utc_ns = 0  # UTC less CLOCK_MONOTONIC

    @abstractmethod
    def _connect(self) -> DeviceInfo:
        """Connect. Raises DeviceLost or ConfigurationError."""

    @abstractmethod
    def _receive(self) -> Iterator[Piece]:
        """The samples of all messages that have come; waits for none. Raises DeviceLost."""

    def _start(self) -> DeviceInfo:
        info = self._connect()
        self._cutter.flag(BlockFlags.RESTART)
        return info

    def _wait(self) -> None:
        self._sleep(self.poll_s * (0.5 + self._next_phase()))  # avoids a beat between polls and messages

    def _poll_once(self) -> bool:
        for piece in self._receive():
            if self._follows(piece):
                self._pieces.append(piece)
                self._waiting += len(piece.indications)
                if self._waiting >= BLOCK_S * self._options.rate_hz:
                    self._finish()
        return True

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
        self._dropped["samples", BACK] += len(piece.indications)
        self._cutter.flag(BlockFlags.RESTART)
        return False

    def _finish(self) -> None:
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
