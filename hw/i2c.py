"""One device on an I2C bus, over smbus2: register reads and writes as the adapter takes them, retries, and a lock.

Adapters differ. One register read (write of the register, then read) a transfer works on every adapter of i2c-dev.
Several reads in one transfer do not: i2c-bcm2835 (Raspberry Pi Zero to 4; Linux, bcm2835_i2c_xfer) takes a read only as
the last message, MCP2221 and CP2112 (Linux, hid-mcp2221.c and hid-cp2112.c) take only write-then-read. CH341 and others
bound the length of a message. Some adapters only know the transfers of SMBus, at most 32 bytes each.
"""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Callable, Sequence
from typing import TypeVar

from smbus2 import SMBus, i2c_msg
from smbus2.smbus2 import I2cFunc

from hw.bus_lock import holder, lock
from hw.sensor import AdapterError, Clock, ConfigurationError, DeviceLost

T = TypeVar("T")
Read = tuple[int, int]
"""First register and number of bytes."""

READS_MAX = 21  # a read needs two messages, and Linux accepts 42 messages per transfer
MESSAGE_BYTES = 8192  # of a message that Linux accepts
SMBUS_BYTES = 32  # of a block, by the SMBus specification
RETRIES = 3
# Time for another master's transfer or clock stretching to end; three waits are too short to fill a FIFO
RETRY_WAIT_S = 0.0005
TRANSIENT = frozenset((errno.ENXIO, errno.EREMOTEIO, errno.EIO, errno.ETIMEDOUT, errno.EAGAIN))
# Linux, i2c_check_for_quirks: EOPNOTSUPP; drivers outside of it also return EOVERFLOW (allanbian1017/i2c-ch341-usb 2)
REFUSED = frozenset((errno.EOPNOTSUPP, errno.EINVAL, errno.EMSGSIZE, errno.EOVERFLOW))
TIMED_READS = 5  # the shortest of them counts: a read may have waited for another process or master


class I2CDevice:
    """A device at `address` of /dev/i2c-`bus`; `kind` names it in messages. `retries` counts the repeated transfers.

    `unit` is the number of bytes of a sample in its FIFO, which one transfer must not divide.

    All methods but `close` raise DeviceLost (the bus is gone, or the device does not answer after the retries),
    AdapterError (the adapter refuses the transfer) or ConfigurationError (a kernel driver holds the address; this class
    never takes it over).
    """

    def __init__(self, kind: str, bus: int, address: int, sleep: Callable[[float], None], unit: int = 1) -> None:
        self.path = f"/dev/i2c-{bus}"
        self.name = f"{kind} at 0x{address:02X} on {self.path}"
        self.retries = 0
        self.joins = False  # whether the adapter takes several reads in one transfer
        self.longest = MESSAGE_BYTES  # bytes of a read that the adapter takes
        self.stamp_half_ns = 0  # the last stamped transfer happened within this time around its stamp
        self._address = address
        self._sleep = sleep
        self._unit = unit
        self._bus: SMBus | None = None
        self._smbus_only = False
        self._transfer_s, self._byte_s = 0.0, 0.0
        self._starts: dict[int, i2c_msg] = {}  # messages that name a register; they do not change from read to read

    def open(self) -> None:
        """Open the bus. Raises AdapterError where the adapter cannot read a block of bytes."""
        self.close()
        try:
            self._bus = SMBus(self.path)
        except OSError as error:
            raise DeviceLost(f"{self.path}: {error.strerror}") from error
        functions = self._bus.funcs
        self._smbus_only = not functions & I2cFunc.I2C
        self.joins = False
        self.longest = SMBUS_BYTES if self._smbus_only else MESSAGE_BYTES
        if self._smbus_only and not functions & I2cFunc.SMBUS_READ_I2C_BLOCK:
            self.close()
            raise AdapterError(
                f"{self.path}: the adapter can neither do plain I2C transfers nor read an I2C block over SMBus, and "
                f"{self.name} needs one of them; use another adapter"
            )

    def lock(self) -> None:
        """Keep other programs that lock, this one included, off this address until `close`. Raises DeviceLost."""
        assert self._bus is not None
        assert self._bus.fd is not None
        lock(self._bus.fd, self.path, self._address, self.name)

    def used_by(self) -> str:
        """The process that holds the lock on this address; "" for none."""
        return holder(self.path, self._address)

    def close(self) -> None:
        """Release the bus; never raises."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError):
                bus.close()

    def learn(self, register: int, wanted: int, clock: Clock) -> None:
        """Find out what the adapter takes, by reads from `register` on that change nothing in the device.

        Sets `joins` and `longest` (at most `wanted` bytes), and measures the time of a transfer. Raises AdapterError
        where the adapter cannot read a sample.
        """
        self.joins = not self._smbus_only and self._takes(register, [1, 1])
        known, refused = 1, min(wanted, SMBUS_BYTES) + 1 if self._smbus_only else wanted + 1
        tried = self.longest = refused - 1
        while known < refused - 1:
            if self._takes(register, [tried]):
                known = tried
            else:
                refused = tried
            tried = (known + refused) // 2
        self.longest = known
        if known < self._unit:
            raise AdapterError(
                f"{self.name}: the adapter reads at most {known} bytes in a transfer, the driver needs {self._unit}; "
                "use another adapter"
            )
        short_s = self._shortest_s(register, 1, clock)
        self._byte_s = max(0.0, self._shortest_s(register, known, clock) - short_s) / max(1, known - 1)
        self._transfer_s = max(0.0, short_s - self._byte_s)

    def time_s(self, transfers: float, data_bytes: float) -> float:
        """Time that so many transfers with together so many bytes take on this adapter, s, as measured by `learn`."""
        return transfers * self._transfer_s + data_bytes * self._byte_s

    def read(self, register: int, count: int) -> bytes:
        """Read `count` bytes, starting at `register`, in one transfer.

        More bytes than the adapter takes can only be those of a FIFO: they are read from the same register in several
        transfers, each of whole samples.
        """
        if count <= self.longest:
            return self._retry(lambda bus: self._transfer(bus, [(register, count)]))
        most = self.longest // self._unit * self._unit
        return b"".join(self.read(register, min(most, count - done)) for done in range(0, count, most))

    def read_each(self, reads: Sequence[Read]) -> bytes:
        """Do all `reads`, in one transfer where the adapter takes that; returns their bytes concatenated."""
        if not self.joins:
            return b"".join(self.read(register, count) for register, count in reads)
        together = [reads[at : at + READS_MAX] for at in range(0, len(reads), READS_MAX)]
        return b"".join(self._retry(lambda bus, some=some: self._transfer(bus, some)) for some in together)  # type: ignore[misc]

    def read_stamped(self, reads: Sequence[Read], clock: Clock) -> tuple[int, int, bytes]:
        """As `read_each`; also returns the middle of the successful transfer, CLOCK_MONOTONIC and UTC, ns.

        Where the adapter needs a transfer for each read, the stamp is the middle of all of them.
        """

        def stamped(bus: SMBus) -> tuple[int, int, bytes]:
            before_ns, _ = clock()
            transfers = [reads] if self.joins else [[read] for read in reads]
            data = b"".join(self._transfer(bus, together) for together in transfers)
            after_ns, utc_ns = clock()
            half_ns = self.stamp_half_ns = (after_ns - before_ns) // 2
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

    def _takes(self, register: int, counts: Sequence[int]) -> bool:
        """Whether the adapter does one transfer of reads of so many bytes from `register` on, and does it right."""
        first = self.read(register, 1)
        try:
            data = self._retry(lambda bus: self._transfer(bus, [(register, count) for count in counts]))
        except AdapterError:
            return False
        except DeviceLost:  # some adapters answer a read that is too long with EIO
            self.read(register, 1)
            return False
        return data[:1] == first and data[-counts[-1] :][:1] == first

    def _shortest_s(self, register: int, count: int, clock: Clock) -> float:
        """Shortest time of some reads, s."""
        times_ns = []
        for _ in range(TIMED_READS):
            before_ns, _ = clock()
            self.read(register, count)
            times_ns.append(clock()[0] - before_ns)
        return min(times_ns) * 1e-9

    def _transfer(self, bus: SMBus, reads: Sequence[Read]) -> bytes:
        """One transfer of all reads; over SMBus there is only one read a transfer."""
        if self._smbus_only:
            ((register, count),) = reads
            return bytes(bus.read_i2c_block_data(self._address, register, count))
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
                if error.errno in REFUSED:
                    raise AdapterError(
                        f"{self.name}: the adapter refuses a transfer that the driver needs ({error.strerror}); "
                        "use another adapter"
                    ) from error
                if error.errno not in TRANSIENT or attempts > RETRIES:
                    raise DeviceLost(f"{self.name}: {error.strerror}") from error
            attempts += 1
            self.retries += 1
            self._sleep(RETRY_WAIT_S)
