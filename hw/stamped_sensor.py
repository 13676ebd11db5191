"""Common part of drivers whose axes come in messages of their own, each with the UTC of its first sample."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import ClassVar

from hw.alignment import Alignment, Samples
from hw.block import BlockFlags
from hw.message_sensor import OUTSIDE, MessageSensor, Piece

STEP_S = 0.1  # a message of several seconds becomes bursts of this length, whose times follow from its start time
ALONE = "samples that one axis had and another had not"


class StampedSensor(MessageSensor):
    """Puts the axes together by the times of their samples. `options` must have `channels` besides.

    Station and gateway must both follow UTC (GPS, NTP or PTP): the times of the samples are the station's, so an error
    of either clock is a lag.
    """

    repeated: ClassVar[str] = "samples that came twice"  # or before which an axis was already

    _alignment: Alignment

    @abstractmethod
    def _take_messages(self) -> None:
        """Hand the samples of all messages that have come to `_add`; waits for none. Raises DeviceLost."""

    def _align(self) -> None:
        """Begin anew with axes that have nothing in common with the samples before."""
        self._alignment = Alignment(len(self._options.channels), self._options.rate_hz)
        self._follow_utc()

    def _add(self, axis: int, start_ns: int, samples: Samples) -> None:
        """Take samples (n,) of an axis; the first one was taken at `start_ns`, UTC."""
        last_ns = start_ns + round((len(samples) - 1) / self._options.rate_hz * 1e9) - self._utc_ns
        if self._is_timely(last_ns):
            self._alignment.add(axis, start_ns, samples)
        else:
            self._dropped["samples", OUTSIDE] += len(samples)

    def _receive(self) -> Iterator[Piece]:
        if self._follow_utc():
            self._alignment.restart()
        self._take_messages()
        for together in self._alignment.take():
            flags, missing = together.flags, together.missing
            step = max(1, round(STEP_S * self._options.rate_hz))
            for begin in range(0, len(together.indications), step):
                part = together.indications[begin : begin + step]
                last = (begin + len(part) - 1) / self._options.rate_hz
                t_utc_ns = together.start_ns + round(last * 1e9)
                yield Piece(part, t_utc_ns - self._utc_ns, t_utc_ns, flags, missing)
                flags, missing = BlockFlags.NONE, 0
        self._dropped["samples", ALONE] += self._alignment.alone
        self._dropped["samples", self.repeated] += self._alignment.repeated
        self._alignment.alone = self._alignment.repeated = 0
