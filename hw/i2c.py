"""One device on an I2C bus, over smbus2: register reads and writes, retried where the failure may pass."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Callable, Sequence
from typing import TypeVar

from smbus2 import SMBus, i2c_msg
from smbus2.smbus2 import I2cFunc

from hw.sensor import Clock, ConfigurationError, DeviceLost

T = TypeVar("T")
Read = tuple[int, int]
"""First register and number of bytes."""

READS_MAX = 21  # each is two messages, and Linux takes 42 a transfer
RETRIES = 3
RETRY_WAIT_S = 0.0005  # lets another master's transfer or a stuck clock end; three of them fill no FIFO
TRANSIENT = frozenset((errno.ENXIO, errno.EREMOTEIO, errno.EIO, errno.ETIMEDOUT, errno.EAGAIN))


class I2CDevice:
    """`name` says in messages who it is. `retries` counts the transfers that had to be repeated so far.

    All methods but `close` raise DeviceLost (bus gone, nothing answers after the retries) or ConfigurationError
    (a kernel driver holds the address: never forced).
    """

    def __init__(self, kind: str, bus: int, address: int, sleep: Callable[[float], None]) -> None:
        self.path = f"/dev/i2c-{bus}"
        self.name = f"{kind} at 0x{address:02X} on {self.path}"
        self.retries = 0
        self._address = address
        self._sleep = sleep
        self._bus: SMBus | None = None

    def open(self) -> None:
        """Open the bus. ConfigurationError if it does SMBus transfers only."""
        self.close()
        try:
            self._bus = SMBus(self.path)
        except OSError as error:
            raise DeviceLost(f"{self.path}: {error.strerror}") from error
        if not self._bus.funcs & I2cFunc.I2C:
            self.close()
            raise ConfigurationError(f"{self.path} does SMBus transfers only, {self.name} needs plain I2C")

    def close(self) -> None:
        """Release the bus; never raises."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError):
                bus.close()

    def read(self, register: int, count: int) -> bytes:
        """`count` bytes from `register` on, in one transfer."""
        return self.read_each([(register, count)])

    def read_each(self, reads: Sequence[Read]) -> bytes:
        """All of `reads` (at most READS_MAX) in one transfer, their bytes one behind the other."""
        return self._retry(lambda bus: self._transfer(bus, reads))

    def read_stamped(self, reads: Sequence[Read], clock: Clock) -> tuple[int, int, bytes]:
        """As `read_each`, with the middle of the transfer that succeeded: CLOCK_MONOTONIC and UTC, ns."""

        def stamped(bus: SMBus) -> tuple[int, int, bytes]:
            before_ns, _ = clock()
            data = self._transfer(bus, reads)
            after_ns, utc_ns = clock()
            half_ns = (after_ns - before_ns) // 2
            return after_ns - half_ns, utc_ns - half_ns, data

        return self._retry(stamped)

    def check_free(self) -> None:
        """Raises ConfigurationError if a kernel driver holds the address, DeviceLost if nobody answers at it."""
        self._retry(lambda bus: bus.read_byte_data(self._address, 0))

    def write(self, register: int, value: int) -> None:
        """One byte to a register, as an SMBus call: the kernel refuses these, and only these, while a driver of its own
        holds the address."""
        self._retry(lambda bus: bus.write_byte_data(self._address, register, value))

    def _transfer(self, bus: SMBus, reads: Sequence[Read]) -> bytes:
        starts = {register: i2c_msg.write(self._address, [register]) for register, _ in reads}
        messages = []
        for register, count in reads:
            messages += [starts[register], i2c_msg.read(self._address, count)]
        bus.i2c_rdwr(*messages)
        return b"".join(map(bytes, messages[1::2]))

    def _retry(self, transfer: Callable[[SMBus], T]) -> T:
        if self._bus is None:
            raise DeviceLost(f"{self.name} is not open")
        attempts = 1
        while True:
            try:
                return transfer(self._bus)
            except OSError as error:
                if error.errno == errno.EBUSY:
                    raise ConfigurationError(f"{self.name}: a kernel driver holds the address; unbind it") from error
                if error.errno not in TRANSIENT or attempts > RETRIES:
                    raise DeviceLost(f"{self.name}: {error.strerror}") from error
            attempts += 1
            self.retries += 1
            self._sleep(RETRY_WAIT_S)
