"""A simulated SPI bus with one chip select, as spidev shows it; for `hw.virtual.kernel`.

errno values and limits are those of Linux, drivers/spi/spidev.c: EMSGSIZE for a message of more than `bufsiz` bytes,
EINVAL for a mode that the controller does not have, ESHUTDOWN where the device was unbound while it was open. SPI has
no acknowledge: where nobody answers, all bits read alike.
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from hw.virtual.node import Node

MAGIC, MESSAGE, MODE32 = ord("k"), 0, 5
WRITE = 1  # direction of an ioctl
TRANSFER = struct.Struct("=QQIIHBBBBBB")  # tx_buf, rx_buf, len, speed_hz, delay, bits, cs_change, and four unused
MODE_BITS = 0x03


@dataclass(frozen=True, slots=True)
class Controller:
    """What a controller takes. `wiring` are bits of the mode that belong to the board."""

    name: str
    bufsiz: int = 4096
    deselects: bool = True  # whether cs_change deselects the device between two transfers
    modes: tuple[int, ...] = (0, 1, 2, 3)
    wiring: int = 0


SPI = Controller("SPI")
SPI_WIRED_HIGH = Controller("SPI, 64 bytes, chip select high", bufsiz=64, wiring=0x04)
SPI_ONE_SELECTION = Controller("SPI, one selection a message", deselects=False)
CONTROLLERS = (SPI, SPI_WIRED_HIGH, SPI_ONE_SELECTION)


class SpiTarget(Protocol):
    """A device on the bus."""

    spi_modes: ClassVar[tuple[int, ...]]
    spi_highest_hz: ClassVar[float]

    def exchange(self, sent: bytes) -> bytes:
        """One frame, from selection to deselection; returns as many bytes. May raise OSError."""


class SpiBus(Node):
    """A node with its target, or None. What nobody sends reads as `idle`.

    Where `spend` is given, it is called with the time of each message in s: `message_s`, and 8 bits at the clock for
    each byte.
    """

    gone_errno = errno.ESHUTDOWN

    def __init__(
        self,
        target: SpiTarget | None,
        *,
        adapter: Controller = SPI,
        idle: int = 0xFF,
        spend: Callable[[float], None] | None = None,
        message_s: float = 0.0,
    ) -> None:
        super().__init__("spidev")
        self.target = target
        self.adapter = adapter
        self.idle = idle
        self.mode = adapter.wiring
        self.transfers = 0  # messages
        self.bytes = 0
        self._clock_level = 0  # at which the clock rests
        self._selected = False  # the last message left the device selected, so that it takes the next one for data
        self._spend = spend
        self._message_s = message_s
        self._lock = threading.Lock()

    def ioctl(self, request: int, argument: Any) -> int:
        """One request; results are written into `argument`, and into the buffers that a message names."""
        direction, size, kind, number = request >> 30, request >> 16 & 0x3FFF, request >> 8 & 0xFF, request & 0xFF
        if kind != MAGIC:
            raise _error(errno.ENOTTY)
        if number == MODE32:
            return self._mode32(direction, argument)
        if number != MESSAGE or direction != WRITE:
            raise _error(errno.ENOTTY)
        if size % TRANSFER.size:
            raise _error(errno.EINVAL)
        return self._message(list(TRANSFER.iter_unpack(bytes(argument)[:size])))

    def _mode32(self, direction: int, argument: Any) -> int:
        if direction != WRITE:
            argument.value = self.mode
            return 0
        if argument.value & MODE_BITS not in self.adapter.modes:
            raise _error(errno.EINVAL)
        self.mode = argument.value
        return 0

    def _message(self, transfers: list[tuple[int, ...]]) -> int:
        if sum(transfer[2] for transfer in transfers) > self.adapter.bufsiz:
            raise _error(errno.EMSGSIZE)
        with self._lock:
            self.transfers += 1
            frame: list[tuple[int, ...]] = []
            for i, transfer in enumerate(transfers):
                frame.append(transfer)
                last = i + 1 == len(transfers)
                if last or (transfer[6] and self.adapter.deselects):
                    self._frame(frame)
                    frame, self._selected = [], last and bool(transfer[6])
        return sum(transfer[2] for transfer in transfers)

    def _frame(self, transfers: list[tuple[int, ...]]) -> None:
        """Transfers of one selection."""
        sent = b"".join(ctypes.string_at(tx, count) for tx, _, count, *_ in transfers)
        clock_hz = max(transfer[3] for transfer in transfers)
        self.bytes += len(sent)
        if self._spend is not None:
            self._spend(self._message_s + 8 * len(sent) / clock_hz)
        received = self._answer(sent, clock_hz)
        for _, rx, count, *_ in transfers:
            ctypes.memmove(rx, received[:count], count)
            received = received[count:]

    def _answer(self, sent: bytes, clock_hz: int) -> bytes:
        """What comes back. A device that does not understand the mode, the clock or the chip select sends nothing."""
        target, level = self.target, self.mode >> 1 & 1
        moved, self._clock_level = level != self._clock_level, level
        if target is None or self._selected or self.mode & ~MODE_BITS != self.adapter.wiring:
            return bytes([self.idle]) * len(sent)
        if self.mode & MODE_BITS not in target.spi_modes or clock_hz > target.spi_highest_hz:
            return bytes([self.idle]) * len(sent)
        if moved:  # the change of the clock's level counts as an edge: all comes a bit late, and no register is found
            return (int.from_bytes(b"\xe5" * len(sent)) >> 1).to_bytes(len(sent))
        return target.exchange(sent)


def _error(number: int) -> OSError:
    return OSError(number, os.strerror(number))
