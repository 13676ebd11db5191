"""One device on an I2C bus, over smbus2: register reads and writes, with retries after transient errors."""

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

READS_MAX = 21  # a read needs two messages, and Linux accepts 42 messages per transfer
RETRIES = 3
# Time for another master's transfer or clock stretching to end; three waits are too short to fill a FIFO
RETRY_WAIT_S = 0.0005
TRANSIENT = frozenset((errno.ENXIO, errno.EREMOTEIO, errno.EIO, errno.ETIMEDOUT, errno.EAGAIN))


class I2CDevice:
    """A device at `address` of /dev/i2c-`bus`; `kind` names it in messages. `retries` counts the repeated transfers.

    All methods but `close` raise DeviceLost (the bus is gone, or the device does not answer after the retries) or
    ConfigurationError (a kernel driver holds the address; this class never takes it over).
    """

    def __init__(self, kind: str, bus: int, address: int, sleep: Callable[[float], None]) -> None:
        self.path = f"/dev/i2c-{bus}"
        self.name = f"{kind} at 0x{address:02X} on {self.path}"
        self.retries = 0
        self._address = address
        self._sleep = sleep
        self._bus: SMBus | None = None
        self._starts: dict[int, i2c_msg] = {}  # messages that name a register; they do not change from read to read

    def open(self) -> None:
        """Open the bus. Raises ConfigurationError if the adapter only supports SMBus transfers."""
        self.close()
        try:
            self._bus = SMBus(self.path)
        except OSError as error:
            raise DeviceLost(f"{self.path}: {error.strerror}") from error
        if not self._bus.funcs & I2cFunc.I2C:
            self.close()
            raise ConfigurationError(f"{self.path} only supports SMBus transfers, {self.name} needs plain I2C")

    def close(self) -> None:
        """Release the bus; never raises."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError):
                bus.close()

    def read(self, register: int, count: int) -> bytes:
        """Read `count` bytes, starting at `register`, in one transfer."""
        return self.read_each([(register, count)])

    def read_each(self, reads: Sequence[Read]) -> bytes:
        """Do all `reads` (at most READS_MAX) in one transfer; returns their bytes concatenated."""
        return self._retry(lambda bus: self._transfer(bus, reads))

    def read_stamped(self, reads: Sequence[Read], clock: Clock) -> tuple[int, int, bytes]:
        """As `read_each`; also returns the middle of the successful transfer, CLOCK_MONOTONIC and UTC, ns."""

        def stamped(bus: SMBus) -> tuple[int, int, bytes]:
            before_ns, _ = clock()
            data = self._transfer(bus, reads)
            after_ns, utc_ns = clock()
            half_ns = (after_ns - before_ns) // 2
            return after_ns - half_ns, utc_ns - half_ns, data

        return self._retry(stamped)

    def check_free(self) -> None:
        """Raise ConfigurationError if a kernel driver holds the address, DeviceLost if no device answers there."""
        self._retry(lambda bus: bus.read_byte_data(self._address, 0))

    def write(self, register: int, value: int) -> None:
        """Write one byte to a register, as an SMBus call.

        While a kernel driver holds the address, the kernel refuses SMBus calls, but not plain I2C transfers.
        """
        self._retry(lambda bus: bus.write_byte_data(self._address, register, value))

    def _transfer(self, bus: SMBus, reads: Sequence[Read]) -> bytes:
        messages = []
        for register, count in reads:
            if register not in self._starts:
                self._starts[register] = i2c_msg.write(self._address, [register])
            messages += [self._starts[register], i2c_msg.read(self._address, count)]
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
                    raise ConfigurationError(
                        f"{self.name}: a kernel driver holds the address; unbind the kernel driver "
                        "or use the driver iio"
                    ) from error
                if error.errno not in TRANSIENT or attempts > RETRIES:
                    raise DeviceLost(f"{self.name}: {error.strerror}") from error
            attempts += 1
            self.retries += 1
            self._sleep(RETRY_WAIT_S)
