"""Replaces the kernel's i2c-dev and spidev under smbus2 and `hw.spi`; only open, close and ioctl are replaced.

errno values and limits are those of Linux 6.1: at most 42 messages per transfer and 8192 bytes per message (EINVAL);
ENXIO or EREMOTEIO, depending on the adapter, for an address without a device; EBUSY for an address that a kernel driver
holds; EIO for an adapter that was removed while it was open, ENOENT afterwards.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Protocol

import smbus2.smbus2 as s2

import hw.spi
from hw.virtual.node import Node
from hw.virtual.spi_bus import SpiBus

MAX_MESSAGES = 42
MAX_MESSAGE_BYTES = 8192
READ = 1  # I2C_M_RD
FUNCTIONS = 0x0EFF0009  # I2C, and the SMBus calls that the kernel implements with it


SMBUS_FUNCTIONS = s2.I2cFunc.SMBUS_BYTE_DATA | s2.I2cFunc.SMBUS_I2C_BLOCK


@dataclass(frozen=True, slots=True)
class Adapter:
    """What an adapter takes. A transfer that it refuses fails with EOPNOTSUPP, as in Linux, i2c_check_for_quirks."""

    name: str
    functions: int = FUNCTIONS
    read_only_last: bool = False  # a read must be the last message of its transfer
    write_then_read: bool = False  # a transfer is a write, a read, or a write and a read
    longest: int = MAX_MESSAGE_BYTES  # bytes of a message


PLAIN = Adapter("plain")
BCM2835 = Adapter("bcm2835", read_only_last=True)  # Raspberry Pi Zero to 4: Linux, bcm2835_i2c_xfer
WRITE_THEN_READ = Adapter("write-then-read", write_then_read=True)  # MCP2221, CP2112
SHORT_MESSAGES = Adapter("32-byte messages", longest=32)
SMBUS_ONLY = Adapter("SMBus only", functions=SMBUS_FUNCTIONS)
ADAPTERS = (PLAIN, BCM2835, WRITE_THEN_READ, SHORT_MESSAGES, SMBUS_ONLY)


class I2CTarget(Protocol):
    """A device on the bus. Both methods may raise OSError, for example if the device does not acknowledge."""

    def write(self, data: bytes) -> None:
        """One write message."""

    def read(self, count: int) -> bytes:
        """One read message."""


class I2CBus(Node):
    """An adapter with its targets by address. A kernel driver holds the addresses in `claimed`.

    Where `spend` is given, it is called with the time of each transfer in s: `transfer_s`, and 9 bits at `clock_hz` for
    each address and byte.
    """

    gone_errno = errno.EIO

    def __init__(
        self,
        targets: Mapping[int, I2CTarget],
        *,
        absent_errno: int = errno.EREMOTEIO,
        adapter: Adapter = PLAIN,
        spend: Callable[[float], None] | None = None,
        transfer_s: float = 0.0,
        clock_hz: float = 400e3,
    ) -> None:
        super().__init__("i2c")
        self.targets = dict(targets)
        self.claimed: set[int] = set()
        self.adapter = adapter
        self.transfers = 0
        self.bytes = 0  # on the bus, addresses among them
        self._absent_errno = absent_errno
        self._spend = spend
        self._transfer_s, self._byte_s = transfer_s, 9 / clock_hz
        self._lock = threading.Lock()

    def transfer(self, messages: list[tuple[int, int | bytes]]) -> list[bytes | None]:
        """Do all messages (address, bytes to write or number of bytes to read); return the bytes read, by message."""
        with self._lock:
            self.transfers += 1
            count = sum(1 + (content if isinstance(content, int) else len(content)) for _, content in messages)
            self.bytes += count
            if self._spend is not None:
                self._spend(self._transfer_s + count * self._byte_s)
            return [self._message(address, content) for address, content in messages]

    def refuses(self, messages: list[tuple[int, int | bytes]]) -> bool:
        """Whether the adapter refuses such a transfer."""
        reads = [isinstance(content, int) for _, content in messages]
        return (
            (self.adapter.read_only_last and any(reads[:-1]))
            or (self.adapter.write_then_read and reads not in ([False], [True], [False, True]))
            or any((c if isinstance(c, int) else len(c)) > self.adapter.longest for _, c in messages)
        )

    def _message(self, address: int, content: int | bytes) -> bytes | None:
        target = self.targets.get(address)
        if target is None:
            raise _error(self._absent_errno)
        if isinstance(content, int):
            return target.read(content)
        target.write(content)
        return None


class Kernel:
    """Files and ioctls of i2c-dev and spidev, on the argument structures of smbus2 and of `hw.spi`.

    All methods raise OSError like the kernel. `installed` puts this object under smbus2 and `hw.spi`. Code that
    forwards the system calls of another process may use it, too.
    """

    def __init__(self, nodes: Mapping[str, I2CBus | SpiBus]) -> None:
        self._nodes = nodes
        self._files: dict[int, tuple[I2CBus | SpiBus, int]] = {}
        self._address: dict[int, int] = {}

    def open(self, path: str, flags: int) -> int:
        """Open the node of an adapter; returns a file descriptor."""
        bus = self._nodes.get(path)
        if bus is None or not bus.plugged:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)
        file = os.open(f"/proc/self/fd/{bus.node}", flags)
        self._files[file] = bus, bus.generation
        return file

    def close(self, file: int) -> None:
        """Close a file descriptor."""
        self._files.pop(file)
        self._address.pop(file, None)
        os.close(file)

    def ioctl(self, file: int, request: int, argument: Any) -> int:
        """One request; results are written into `argument`."""
        bus, generation = self._files[file]
        if generation != bus.generation:
            raise _error(bus.gone_errno)
        if isinstance(bus, SpiBus):
            return bus.ioctl(request, argument)
        match request:
            case s2.I2C_FUNCS:
                argument.value = bus.adapter.functions
            case s2.I2C_SLAVE | s2.I2C_SLAVE_FORCE:
                if request == s2.I2C_SLAVE and argument in bus.claimed:
                    raise _error(errno.EBUSY)
                self._address[file] = argument
            case s2.I2C_SMBUS:
                _smbus(bus, self._address[file], argument)
            case s2.I2C_RDWR:
                return _rdwr(bus, argument)
            case _:
                raise _error(errno.ENOTTY)
        return 0


def _rdwr(bus: I2CBus, argument: Any) -> int:
    if not bus.adapter.functions & s2.I2cFunc.I2C:
        raise _error(errno.EOPNOTSUPP)
    messages = [argument.msgs[i] for i in range(min(argument.nmsgs, MAX_MESSAGES + 1))]
    if len(messages) > MAX_MESSAGES or any(message.len > MAX_MESSAGE_BYTES for message in messages):
        raise _error(errno.EINVAL)
    contents = [(m.addr, m.len if m.flags & READ else ctypes.string_at(m.buf, m.len)) for m in messages]
    if bus.refuses(contents):
        raise _error(errno.EOPNOTSUPP)
    results = bus.transfer(contents)
    for message, result in zip(messages, results, strict=True):
        if result is not None:
            ctypes.memmove(message.buf, result, len(result))
    return len(messages)


def _smbus(bus: I2CBus, address: int, argument: Any) -> None:
    """Byte data and I2C block data, the calls that drivers use; the adapter turns them into plain messages."""
    block = argument.data.contents.block
    command = bytes([argument.command])
    reading = argument.read_write == s2.I2C_SMBUS_READ
    if argument.size == s2.I2C_SMBUS_BYTE_DATA:
        first, count = 0, 1
    elif argument.size == s2.I2C_SMBUS_I2C_BLOCK_DATA:
        first, count = 1, block[0]
        if not 1 <= count <= s2.I2C_SMBUS_BLOCK_MAX:
            raise _error(errno.EINVAL)
    else:
        raise _error(errno.EOPNOTSUPP)
    if not reading:
        bus.transfer([(address, command + bytes(block[first : first + count]))])
        return
    result = bus.transfer([(address, command), (address, count)])[1]
    block[first : first + count] = list(result or b"")


def _error(number: int) -> OSError:
    return OSError(number, os.strerror(number))


@contextlib.contextmanager
def installed(nodes: Mapping[str, I2CBus | SpiBus]) -> Iterator[None]:
    """While this context is active, smbus2 and `hw.spi` find these buses and no others.

    Their keys are paths, e.g. /dev/i2c-1 or /dev/spidev0.0.
    """
    kernel = Kernel(nodes)
    calls = SimpleNamespace(open=kernel.open, close=kernel.close, O_RDWR=os.O_RDWR, O_CLOEXEC=os.O_CLOEXEC)
    modules = vars(s2), vars(hw.spi)
    before = [(module["ioctl"], module["os"]) for module in modules]
    for module in modules:
        module["ioctl"], module["os"] = kernel.ioctl, calls
    try:
        yield
    finally:
        for module, held in zip(modules, before, strict=True):
            module["ioctl"], module["os"] = held
