"""An ADXL355 at register level with its live FIFO, for `hw.virtual.kernel`; the physics comes from outside."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

IDENTITY = bytes([0xAD, 0x1D, 0xED, 0x01])
FIFO_BYTES = 96 * 3
EMPTY_ENTRY = b"\x00\x00\x02"
RESET_S = 0.005  # so long after a reset the shadow registers are not loaded and settings do not take
SHADOW = bytes([0x4C, 0x21, 0x9A, 0x05, 0x33])  # trim of this part, any constant does
STATUS, FIFO_ENTRIES, TEMPERATURE, FIFO_DATA = 0x04, 0x05, 0x06, 0x11
FIRST_SETTING, LAST_SETTING, POWER_CTL, RESET, RESET_CODE, SHADOW_1 = 0x1E, 0x2E, 0x2D, 0x2F, 0x52, 0x50
RESET_VALUES = {0x27: 0x01, 0x29: 0x60, 0x2C: 0x81, POWER_CTL: 0x01}


def encode(counts: NDArray[np.int32]) -> bytes:
    """FIFO entries of (n, 3) counts: 20 bits each, left-justified in 3 bytes, bit 0 marks X."""
    words = (counts.astype(np.uint32) & 0xFFFFF) << 4
    words[:, 0] |= 1
    return words.astype(">u4").view(np.uint8).reshape(-1, 4)[:, 1:].tobytes()


class Adxl355Twin:
    """`source(first, n)` returns (n, 3) int32 counts of samples first .. first + n - 1, at the set range;
    `samples_due(t_s)` how many samples exist at `t_s` in all; `clock()` is that time, in seconds.

    Samples go on being counted in standby, but only those made while measuring reach the FIFO, which holds 32.
    """

    def __init__(
        self,
        source: Callable[[int, int], NDArray[np.int32]],
        samples_due: Callable[[float], int],
        clock: Callable[[], float],
        *,
        identity: bytes = IDENTITY,
        temperature_raw: Callable[[float], int] = lambda t_s: 1885,  # noqa: ARG005 - 25 degC at all times
    ) -> None:
        self._source = source
        self._samples_due = samples_due
        self._clock = clock
        self._identity = identity
        self._temperature_raw = temperature_raw
        self._failures: list[int] = []
        self._broken_off: tuple[int, int] | None = None
        self.power_cycle()
        self._ready_s = clock()  # it was powered long before

    def power_cycle(self) -> None:
        """Power fails and comes back: registers as after a reset, standby."""
        self.registers = bytearray(256)
        self.registers[: len(self._identity)] = self._identity
        for register, value in RESET_VALUES.items():
            self.registers[register] = value
        self._pointer = 0
        self._fifo = bytearray()
        self._overrun = False
        self._next = 0
        self._ready_s = self._clock() + RESET_S

    def steal(self, entry: int = 0, count: int = 1) -> None:
        """Fault: entries vanish from the FIFO, the first of them at place `entry`."""
        self._fill()
        del self._fifo[3 * entry : 3 * (entry + count)]

    def fail(self, number: int, times: int = 1) -> None:
        """Fault: the next messages end in this errno."""
        self._failures += [number] * times

    def break_off(self, number: int, entries: int) -> None:
        """Fault: the next FIFO read ends in this errno after so many entries went out in vain."""
        self._broken_off = number, entries

    def write(self, data: bytes) -> None:
        """One I2C write message: register, then values."""
        self._fail()
        self._pointer = data[0]
        for value in data[1:]:
            self._set(self._pointer, value)
            self._pointer = (self._pointer + 1) & 0xFF

    def read(self, count: int) -> bytes:
        """One I2C read message, from the register written last on; FIFO_DATA stays where it is."""
        self._fail()
        self._fill()
        self._break_off()
        out = bytearray()
        while len(out) < count:
            if self._pointer == FIFO_DATA:
                out += self._take(count - len(out))
            else:
                out.append(self._get(self._pointer))
                self._pointer = (self._pointer + 1) & 0xFF
        return bytes(out)

    def _fail(self) -> None:
        if self._failures:
            raise _error(self._failures.pop(0))

    def _break_off(self) -> None:
        if self._broken_off and self._pointer == FIFO_DATA:
            number, entries = self._broken_off
            self._broken_off = None
            self._take(3 * entries)
            raise _error(number)

    def _take(self, count: int) -> bytes:
        taken = bytes(self._fifo[:count])
        del self._fifo[:count]
        missing = count - len(taken)
        return taken + (EMPTY_ENTRY * (missing // 3 + 1))[:missing]

    @property
    def _measuring(self) -> bool:
        return not self.registers[POWER_CTL] & 1

    def _fill(self) -> None:
        if not self._measuring:
            return
        due = self._samples_due(self._clock())
        if due <= self._next:
            return
        room = FIFO_BYTES // 9 + 1  # one more than it holds, so that an overflow shows
        first = max(self._next, due - room)
        self._fifo += encode(self._source(first, due - first))
        self._next = due
        if len(self._fifo) > FIFO_BYTES:
            self._overrun = True
            del self._fifo[: len(self._fifo) - FIFO_BYTES]

    def _get(self, register: int) -> int:
        if register == STATUS:
            entries = len(self._fifo) // 3
            full = entries >= self.registers[0x29]
            status = bool(entries) | full << 1 | self._overrun << 2
            self._overrun = False
            return status
        if register == FIFO_ENTRIES:
            return len(self._fifo) // 3
        if register in (TEMPERATURE, TEMPERATURE + 1):
            raw = self._temperature_raw(self._clock()) & 0xFFF
            return raw >> 8 if register == TEMPERATURE else raw & 0xFF
        if SHADOW_1 <= register < SHADOW_1 + len(SHADOW):
            return SHADOW[register - SHADOW_1] if self._clock() >= self._ready_s else 0
        return self.registers[register]

    def _set(self, register: int, value: int) -> None:
        if register == RESET and value == RESET_CODE:
            self.power_cycle()
        elif self._clock() < self._ready_s:
            return
        elif register == POWER_CTL:
            if self._measuring != (not value & 1):
                self._fifo.clear()
                self._next = self._samples_due(self._clock())
            self.registers[register] = value
        elif FIRST_SETTING <= register <= LAST_SETTING and not self._measuring:
            self.registers[register] = value


def _error(number: int) -> OSError:
    return OSError(number, os.strerror(number))
