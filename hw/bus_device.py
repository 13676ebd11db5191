"""A device with registers on a bus: what I2C and SPI have in common. Reads, retries, and what the adapter takes."""

from __future__ import annotations

import errno
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

from hw.bus_lock import holder, lock
from hw.sensor import AdapterError, Clock, ConfigurationError, DeviceLost

T = TypeVar("T")
Read = tuple[int, int]
"""First register and number of bytes."""

READS_MAX = 21  # in one transfer: on I2C a read needs two messages, and Linux accepts 42 messages per transfer
RETRIES = 3
# Time for another master's transfer or clock stretching to end; three waits are too short to fill a FIFO
RETRY_WAIT_S = 0.0005
TRANSIENT = frozenset((errno.ENXIO, errno.EREMOTEIO, errno.EIO, errno.ETIMEDOUT, errno.EAGAIN))
# Linux, i2c_check_for_quirks: EOPNOTSUPP; drivers outside of it also return EOVERFLOW (allanbian1017/i2c-ch341-usb 2);
# spidev: EMSGSIZE
NOT_ACKNOWLEDGED = (errno.ENXIO, errno.EREMOTEIO)  # by the device at this address
REFUSED = frozenset((errno.EOPNOTSUPP, errno.EINVAL, errno.EMSGSIZE, errno.EOVERFLOW))
TIMED_READS = 5  # the shortest of them counts: a read may have waited for another process or master


class BusDevice(ABC):
    """A device on the bus with the node `path`; `name` names it in messages. `retries` counts the repeated transfers.

    `place` tells the devices on one node apart: the address on I2C.

    `unit` is the number of bytes of a sample in its FIFO, which one transfer must not divide.

    All methods but `close` raise DeviceLost (the bus is gone, or the device does not answer after the retries),
    AdapterError (the adapter refuses the transfer) or ConfigurationError (a kernel driver holds the device; this class
    never takes it over).
    """

    def __init__(
        self, path: str, place: int, name: str, longest: int, sleep: Callable[[float], None], unit: int
    ) -> None:
        self.path = path
        self._place = place
        self.name = name
        self.retries = 0
        self.joins = False  # whether the adapter does several reads in one transfer
        self.longest = longest  # bytes of a read that the adapter takes
        self.stamp_half_ns = 0  # the last stamped transfer happened within this time around its stamp
        self._sleep = sleep
        self._unit = unit
        self._transfer_s, self._byte_s = 0.0, 0.0

    @abstractmethod
    def open(self) -> None:
        """Open the bus. Raises AdapterError where the adapter cannot reach the device as it needs."""

    @abstractmethod
    def close(self) -> None:
        """Release the bus; never raises."""

    @abstractmethod
    def check_free(self, register: int) -> None:
        """Raise ConfigurationError if a kernel driver holds the device, DeviceLost if no device answers.

        Reading `register` must do no harm.
        """

    @abstractmethod
    def write(self, register: int, value: int) -> None:
        """Write one byte to a register."""

    @abstractmethod
    def _descriptor(self) -> int:
        """The open file of the node. Raises DeviceLost if it is not open."""

    @abstractmethod
    def _transfer(self, reads: Sequence[Read]) -> bytes:
        """Do all `reads` in one transfer; their bytes concatenated. Raises OSError; DeviceLost if it is not open."""

    def lock(self) -> None:
        """Keep other programs that lock, this one included, off this device until `close`. Raises DeviceLost."""
        lock(self._descriptor(), self.path, self._place, self.name)

    def used_by(self) -> str:
        """The process that holds the lock on this device; "" for none."""
        return holder(self.path, self._place)

    def learn(self, register: int, wanted: int, clock: Clock) -> None:
        """Find out what the adapter takes, by reads from `register` on that change nothing in the device.

        Sets `joins` and `longest` (at most `wanted` bytes), and measures the time of a transfer. Raises AdapterError
        where the adapter cannot read a sample.
        """
        self.joins = self._takes(register, [2, 2])
        known, refused = 1, min(wanted, self.longest) + 1
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
            return self._retry(lambda: self._transfer([(register, count)]))
        most = self.longest // self._unit * self._unit
        return b"".join(self.read(register, min(most, count - done)) for done in range(0, count, most))

    def read_each(self, reads: Sequence[Read]) -> bytes:
        """Do all `reads`, in one transfer where the adapter takes that; returns their bytes concatenated."""
        if not self.joins:
            return b"".join(self.read(register, count) for register, count in reads)
        return b"".join(self._retry(lambda some=some: self._transfer(some)) for some in self._together(reads))  # type: ignore[misc]

    def read_stamped(self, reads: Sequence[Read], clock: Clock) -> tuple[int, int, bytes]:
        """As `read_each`; also returns the middle of the successful transfer, CLOCK_MONOTONIC and UTC, ns.

        Where the adapter needs a transfer for each read, the stamp is the middle of all of them.
        """

        def stamped() -> tuple[int, int, bytes]:
            before_ns, _ = clock()
            parts = [reads] if self.joins else [[read] for read in reads]
            data = b"".join(self._transfer(part) for part in parts)
            after_ns, utc_ns = clock()
            half_ns = self.stamp_half_ns = (after_ns - before_ns) // 2
            return after_ns - half_ns, utc_ns - half_ns, data

        return self._retry(stamped)

    def _together(self, reads: Sequence[Read]) -> Iterable[Sequence[Read]]:
        """The reads in parts, each for one transfer."""
        return [reads[at : at + READS_MAX] for at in range(0, len(reads), READS_MAX)]

    def _takes(self, register: int, counts: Sequence[int]) -> bool:
        """Whether the adapter does one transfer of reads of so many bytes from `register` on, and does it right."""
        first = self.read(register, 1)
        try:
            data = self._retry(lambda: self._transfer([(register, count) for count in counts]))
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

    def _retry(self, transfer: Callable[[], T]) -> T:
        attempts = 1
        while True:
            try:
                return transfer()
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
                    silent = error.errno in NOT_ACKNOWLEDGED
                    reason = f"no device answers ({error.strerror})" if silent else error.strerror
                    raise DeviceLost(f"{self.name}: {reason}") from error
            attempts += 1
            self.retries += 1
            self._sleep(RETRY_WAIT_S)
