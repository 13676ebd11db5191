"""Common part of all register-level twins with a FIFO, for `hw.virtual.kernel`."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hw.virtual.response import Response, delay

Counts = NDArray[np.int32]


class FifoTwin(ABC):
    """A chip on an I2C bus or, where it has `spi_modes`, on an SPI bus.

    Motion, noise, time and temperature come from the arguments.

    - `source(first, n)` returns (n, 3) int32 counts of samples first .. first + n - 1 at the set range.
    - `samples_due(t_s)`: number of samples that exist at `t_s`.
    - `clock()`: the present time t_s, s.
    - `temperature_raw(t_s)`: raw temperature value of the chip.
    - `electrostatic(t_s)`: factor (3,) of the deflection by the self-test, as supply and temperature are then.

    Samples are counted while the FIFO is off, too, but only samples made while it is on go into it.
    """

    fifo_bytes: ClassVar[int]
    sample_bytes: ClassVar[int]
    word_bytes: ClassVar[int]
    data_register: ClassVar[int]
    temperature_at_25_degc: ClassVar[int] = 0
    spi_modes: ClassVar[tuple[int, ...]] = ()
    spi_highest_hz: ClassVar[float] = 0.0

    def __init__(
        self,
        source: Callable[[int, int], Counts],
        samples_due: Callable[[float], int],
        clock: Callable[[], float],
        *,
        temperature_raw: Callable[[float], int] | None = None,
        electrostatic: Callable[[float], NDArray[np.float64]] | None = None,
    ) -> None:
        self._source = source
        self._samples_due = samples_due
        self._clock = clock
        self._temperature_raw = temperature_raw or (lambda _: self.temperature_at_25_degc)
        self._electrostatic = electrostatic or (lambda _: np.ones(3))
        self._failures: list[int] = []
        self._latched: Counts | None = None
        self._broken_off: tuple[int, int] | None = None
        self.power_cycle()

    @abstractmethod
    def _reset_registers(self) -> bytearray:
        """All registers as after a reset."""

    @property
    @abstractmethod
    def _filling(self) -> bool:
        """Whether new samples go into the FIFO."""

    @abstractmethod
    def _encode(self, first: int, counts: Counts) -> bytes:
        """FIFO words of samples first .. first + n - 1."""

    @abstractmethod
    def _get(self, register: int) -> int:
        """Value of one register that is read."""

    @abstractmethod
    def _set(self, register: int, value: int) -> None:
        """Write one register."""

    def _reading(self, register: int, temperature: int, data: int) -> int:
        """A byte of the temperature or of the newest sample, whose registers begin there with the high byte; of another
        register its content."""
        if temperature <= register < temperature + 2:
            raw = self._temperature_raw(self._clock())
            return raw.to_bytes(2, "big", signed=True)[register - temperature]
        if data <= register < data + 6:
            return self._newest().astype(">i2").tobytes()[register - data]
        return self.registers[register]

    def _selected(self, address: int) -> int:
        """Register that the first byte of a write message selects."""
        return address

    def _after(self, register: int) -> int:
        """Register that is read or written after `register` in one message."""
        return register & ~0xFF | (register + 1) & 0xFF

    def _spi_command(self, first: int) -> tuple[int, bool, bool]:
        """Meaning of the first byte of an SPI frame: register, whether it reads, whether the register counts up."""
        raise NotImplementedError

    def _deflection(self) -> Counts:
        """Change (3,) of the counts by the self-test."""
        return np.zeros(3, np.int32)

    def _deflected(self, counts: Counts) -> Counts:
        """Counts (n, 3) with what the self-test adds now."""
        deflection = self._deflection()
        if not deflection.any():
            return counts
        return counts + np.rint(deflection * self._electrostatic(self._clock())).astype(np.int32)

    @property
    def response(self) -> Response:
        """What its filters, as the registers set them, make of a motion; `source` has to pass the motion through."""
        return delay(0.0)

    def _newest(self) -> Counts:
        """Contents (3,) of the output registers: the newest sample; it does not change within one I2C message."""
        if self._latched is None:
            due = self._samples_due(self._clock())
            self._latched = self._deflected(self._source(due - 1, 1))[0] if due else np.zeros(3, np.int32)
        return self._latched

    def power_cycle(self) -> None:
        """Power fails and comes back, or the device is reset: registers have their reset values, the FIFO is empty."""
        self.registers = self._reset_registers()
        self._pointer = 0
        self._latched = None
        self._empty()
        self._overrun = False

    def steal(self, word: int = 0, count: int = 1) -> None:
        """Fault: remove `count` words from the FIFO, from position `word` on."""
        self._fill()
        del self._fifo[self.word_bytes * word : self.word_bytes * (word + count)]

    def fail(self, number: int, times: int = 1) -> None:
        """Fault: the next `times` messages fail with errno `number`."""
        self._failures += [number] * times

    def break_off(self, number: int, words: int) -> None:
        """Fault: the next FIFO read removes `words` words and then fails with errno `number`."""
        self._broken_off = number, words

    def write(self, data: bytes) -> None:
        """One I2C write message: register, then values."""
        self._fail()
        self._pointer = self._selected(data[0])
        for value in data[1:]:
            self._set(self._pointer, value)
            self._pointer = self._after(self._pointer)

    def read(self, count: int) -> bytes:
        """One I2C read message; it starts at the register that was written last."""
        self._fail()
        self._latched = None
        self._fill()
        out = bytearray()
        while len(out) < count:
            if self._pointer == self.data_register:
                self._break_off()
                out += self._read_fifo(count - len(out))
            else:
                out.append(self._get(self._pointer))
                self._pointer = self._after(self._pointer)
        return bytes(out)

    def exchange(self, sent: bytes) -> bytes:
        """One SPI frame, from selection to deselection. Its first byte names the register."""
        register, reads, counts_up = self._spi_command(sent[0])
        if not reads:
            for i, value in enumerate(sent[1:]):
                self.write(bytes([register + (i if counts_up else 0), value]))
            return bytes(len(sent))
        self.write(bytes([register]))
        if counts_up or register == self.data_register:
            return b"\0" + self.read(len(sent) - 1)
        received = self.read(1)
        return b"\0" + received * (len(sent) - 1)

    def _break_off(self) -> None:
        if self._broken_off is not None:
            number, words = self._broken_off
            self._broken_off = None
            self._take(self.word_bytes * words)
            raise error(number)

    def _read_fifo(self, count: int) -> bytes:
        """Bytes that a read of `count` bytes from the data register returns."""
        return self._take(count)

    def _take(self, count: int) -> bytes:
        taken = bytes(self._fifo[:count])
        del self._fifo[:count]
        return taken + self._nothing(count - len(taken))

    def _nothing(self, count: int) -> bytes:
        """Bytes that a read from an empty FIFO returns."""
        return bytes(count)

    def _empty(self) -> None:
        """Empty the FIFO; samples made from now on may go into it."""
        self._fifo = bytearray()
        self._next = self._samples_due(self._clock()) if self._filling else 0

    def _fill(self) -> None:
        if not self._filling:
            return
        due = self._samples_due(self._clock())
        if due <= self._next:
            return
        room = self.fifo_bytes // self.sample_bytes + 1  # one sample more than the FIFO holds, to detect an overflow
        first = max(self._next, due - room)
        self._fifo += self._encode(first, self._deflected(self._source(first, due - first)))
        self._next = due
        if len(self._fifo) > self.fifo_bytes:
            self._overrun = True
            del self._fifo[: len(self._fifo) - self.fifo_bytes]

    def _fail(self) -> None:
        if self._failures:
            raise error(self._failures.pop(0))


def error(number: int) -> OSError:
    """The OSError that the kernel returns for this errno."""
    return OSError(number, os.strerror(number))
