"""A WitMotion sensor at the level of its bytes, for `PtyDevice`."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

OUTPUT, RATE, OFFSET_X, BANDWIDTH, VERSION, READ, KEY, NUMBER = 0x02, 0x03, 0x05, 0x1F, 0x2E, 0x27, 0x69, 0x7F
UNLOCK = 0xB588
COMMAND_BYTES = 5


def frame(kind: int, *words: int) -> bytes:
    """One frame: 55, kind, four words, sum."""
    body = struct.pack("<BB4H", 0x55, kind, *(word & 0xFFFF for word in words))
    return body + bytes([sum(body) & 0xFF])


class WitMotionTwin:
    """A sensor that takes one sample every 1 / `rate_hz`; `text_due` and `received` are arguments of `PtyDevice`.

    `source(first, n)` returns (n, 3) counts, `samples_due(t_s)` the number of samples that exist at `t_s`.
    """

    def __init__(
        self, source: Callable[[int, int], NDArray[np.int32]], samples_due: Callable[[float], int], rate_hz: float
    ) -> None:
        self._source = source
        self._samples_due = samples_due
        self._rate_hz = rate_hz
        self.next = 0
        self.power_cycle()

    def power_cycle(self) -> None:
        """Power fails and comes back: registers have their saved values, the clock starts again."""
        self.registers = dict.fromkeys(range(256), 0)
        self.registers |= {OUTPUT: 0x1E, RATE: 6, OFFSET_X: 12, BANDWIDTH: 4, VERSION: 0x2710}
        self.registers |= dict(enumerate(struct.unpack("<6H", b"WT4200001234"), NUMBER))
        self.locked = True
        self._commands = b""
        self._answers = b""
        self._zero = self.next

    def received(self, data: bytes) -> None:
        """Handle the commands in `data`, which may be split anywhere."""
        self._commands += data
        while len(self._commands) >= COMMAND_BYTES:
            head, register, value = struct.unpack("<HBH", self._commands[:COMMAND_BYTES])
            if head != 0xAAFF:
                self._commands = self._commands[1:]
                continue
            self._commands = self._commands[COMMAND_BYTES:]
            if register == READ:
                self._answers += frame(0x5F, *(self.registers[(value + i) & 0xFF] for i in range(4)))
            elif register == KEY:
                self.locked = value != UNLOCK
            elif not self.locked:
                self.registers[register] = value

    def text_due(self, t_s: float) -> bytes:
        """Frames that became due, with the contents that the registers select."""
        due = self._samples_due(t_s)
        first, self.next = self.next, max(self.next, due)
        text, self._answers = self._answers, b""
        return text + b"".join(
            self._sample(first + i, counts) for i, counts in enumerate(self._source(first, self.next - first).tolist())
        )

    def _sample(self, number: int, counts: list[int]) -> bytes:
        asked = self.registers[OUTPUT]
        ms = int((number - self._zero) * 1e3 / self._rate_hz)
        seconds, within = divmod(ms, 1000)
        minutes, second = divmod(seconds, 60)
        hours, minute = divmod(minutes, 60)
        text = b""
        if asked & 0x01:
            text += frame(0x50, 15 | 1 << 8, 1 | hours % 24 << 8, minute | second << 8, within)
        if asked & 0x02:
            text += frame(0x51, *counts, 2503)
        if asked & 0x04:
            text += frame(0x52, 0x5555, 0x5155, 0x5555, 0x5055)  # bytes that look like the start of frames
        return text
