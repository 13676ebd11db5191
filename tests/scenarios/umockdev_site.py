"""Simulated I2C and SPI buses for another, unmodified process, whose system calls libumockdev's preload library sends.

The library sends each ioctl on a device node of its test bed to a socket. The program at the socket can let it read and
write the memory of the process. A request is three unsigned longs. From the process come 1 (ioctl), 7 (read) and
8 (write), each with two arguments. The answers are 3 (end of the call, with return value and errno), 5 (read memory)
and 6 (write memory). This interface is not documented; source: umockdev 0.17.16, src/libumockdev-preload.c.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
import socket
import struct
import subprocess
import tempfile
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

import smbus2.smbus2 as s2

import hw.spi
from hw.spi import Transfer
from hw.virtual.kernel import READ, I2CBus, Kernel
from hw.virtual.spi_bus import MAGIC, SpiBus

LIBRARY = "libumockdev-preload.so.0"
REQUEST = struct.Struct("@LLL")
IOCTL, DONE, READ_MEMORY, WRITE_MEMORY = 1, 3, 5, 6
FAILED = -1 & 0xFFFFFFFFFFFFFFFF
NOT_MINE = -100 & 0xFFFFFFFFFFFFFFFF  # return value with which the library makes the real system call


def absence() -> str | None:
    """Why umockdev cannot be used on this machine; None if it can."""
    done = subprocess.run(
        ["/bin/true"], env={"LD_PRELOAD": LIBRARY}, capture_output=True, text=True, timeout=60, check=False
    )
    return f"no umockdev here (apt-get install umockdev): {done.stderr.strip()}" if done.stderr else None


class UmockdevSite:
    """Context manager. Processes started with `environment` find these buses under their paths, and no others."""

    def __init__(self, nodes: Mapping[str, I2CBus | SpiBus]) -> None:
        self._nodes = nodes
        self._kernel = Kernel(nodes)
        # The path of a socket may have 107 characters at most, and pytest's directories have long paths.
        self._directory = Path(tempfile.mkdtemp(prefix="fieldcal-"))
        self._listeners: list[socket.socket] = []
        self._connections: list[socket.socket] = []

    @property
    def environment(self) -> dict[str, str]:
        """The environment variables that a process needs."""
        return {"UMOCKDEV_DIR": str(self._directory), "LD_PRELOAD": LIBRARY}

    def __enter__(self) -> UmockdevSite:
        (self._directory / "sys").mkdir()
        for node in self._nodes:
            self._file(node).parent.mkdir(parents=True, exist_ok=True)
            path = self._directory / "ioctl" / node.removeprefix("/")
            path.parent.mkdir(parents=True, exist_ok=True)
            listener = socket.socket(socket.AF_UNIX)
            listener.bind(str(path))
            listener.listen()
            self._listeners.append(listener)
            threading.Thread(target=self._accept, args=(listener, node), daemon=True).start()
            self.replug(node)
        return self

    def __exit__(self, *_: object) -> None:
        for end in (*self._listeners, *self._connections):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        shutil.rmtree(self._directory)

    def unplug(self, node: str) -> None:
        """Remove the adapter and its device node."""
        self._nodes[node].unplug()
        self._file(node).unlink()

    def replug(self, node: str) -> None:
        """Add the adapter and its device node again."""
        self._nodes[node].replug()
        self._file(node).touch()

    def _file(self, node: str) -> Path:
        return self._directory / node.removeprefix("/")

    def _accept(self, listener: socket.socket, node: str) -> None:
        with contextlib.suppress(OSError):  # closed at the end
            while True:
                connection, _ = listener.accept()
                self._connections.append(connection)
                threading.Thread(target=self._serve, args=(connection, node), daemon=True).start()

    def _serve(self, connection: socket.socket, node: str) -> None:
        """Answer the system calls on one open file of the process."""
        memory = Memory(connection)
        try:
            file = self._kernel.open(node, os.O_RDWR)
        except FileNotFoundError:  # the adapter was removed after the process had opened it
            file = None
        with contextlib.suppress(EOFError, OSError):
            while True:
                command, request, address = REQUEST.unpack(memory.receive(REQUEST.size))
                memory.send(REQUEST.pack(DONE, *self._answer(memory, file, command, request, address)))
        if file is not None:
            self._kernel.close(file)

    def _answer(self, memory: Memory, file: int | None, command: int, request: int, address: int) -> tuple[int, int]:
        """Return value and errno."""
        if command != IOCTL:
            return NOT_MINE, 0
        if file is None:
            return FAILED, errno.ENODEV
        try:
            return ioctl(memory, lambda argument: self._kernel.ioctl(file, request, argument), request, address), 0
        except ConnectionError:
            raise
        except OSError as error:
            return FAILED, error.errno or errno.EIO


class Memory:
    """The memory of the process at the other end of a connection."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection

    def receive(self, count: int) -> bytes:
        """Receive `count` bytes. Raises EOFError at the end."""
        data = b""
        while len(data) < count:
            part = self._connection.recv(count - len(data))
            if not part:
                raise EOFError
            data += part
        return data

    def send(self, data: bytes) -> None:
        """Send all of `data`."""
        self._connection.sendall(data)

    def read(self, address: int, count: int) -> bytes:
        """Read `count` bytes at an address of the process."""
        if not count:
            return b""
        self.send(REQUEST.pack(READ_MEMORY, address, count))
        return self.receive(count)

    def write(self, address: int, data: bytes) -> None:
        """Write bytes to an address of the process."""
        if data:
            self.send(REQUEST.pack(WRITE_MEMORY, address, len(data)) + data)


def ioctl(memory: Memory, call: Callable[[object], int], request: int, address: int) -> int:
    """Make the ioctl `call` with a copy of the argument at `address`, and write the changed argument back."""
    match request:
        case s2.I2C_SLAVE | s2.I2C_SLAVE_FORCE:
            return call(address)
        case s2.I2C_FUNCS:
            functions = ctypes.c_ulong()
            result = call(functions)
            memory.write(address, bytes(functions))
            return result
        case s2.I2C_SMBUS:
            return _smbus(memory, call, address)
        case s2.I2C_RDWR:
            return _transfer(memory, call, address)
        case hw.spi.RD_MODE32 | hw.spi.WR_MODE32:
            mode = ctypes.c_uint32.from_buffer_copy(memory.read(address, 4))
            result = call(mode)
            memory.write(address, bytes(mode))
            return result
        case _ if request >> 8 & 0xFF == MAGIC:
            return _spi_message(memory, call, request, address)
        case _:
            return call(None)


def _spi_message(memory: Memory, call: Callable[[object], int], request: int, address: int) -> int:
    size = request >> 16 & 0x3FFF
    transfers = (Transfer * (size // ctypes.sizeof(Transfer))).from_buffer_copy(memory.read(address, size))
    kept = []
    for transfer in transfers:
        sent = ctypes.create_string_buffer(memory.read(transfer.tx_buf, transfer.len))
        received = ctypes.create_string_buffer(transfer.len)
        kept.append((transfer.rx_buf, sent, received))
        transfer.tx_buf, transfer.rx_buf = ctypes.addressof(sent), ctypes.addressof(received)
    result = call(transfers)
    for there, _, received in kept:
        memory.write(there, received.raw)
    return result


def _smbus(memory: Memory, call: Callable[[object], int], address: int) -> int:
    argument = s2.i2c_smbus_ioctl_data.from_buffer_copy(
        memory.read(address, ctypes.sizeof(s2.i2c_smbus_ioctl_data)),
    )
    there = ctypes.cast(argument.data, ctypes.c_void_p).value or 0
    data = s2.union_i2c_smbus_data.from_buffer_copy(memory.read(there, ctypes.sizeof(s2.union_i2c_smbus_data)))
    argument.data = ctypes.pointer(data)
    result = call(argument)
    memory.write(there, bytes(data))
    return result


def _transfer(memory: Memory, call: Callable[[object], int], address: int) -> int:
    argument = s2.i2c_rdwr_ioctl_data.from_buffer_copy(memory.read(address, ctypes.sizeof(s2.i2c_rdwr_ioctl_data)))
    there = ctypes.cast(argument.msgs, ctypes.c_void_p).value or 0
    messages = (s2.i2c_msg * argument.nmsgs).from_buffer_copy(
        memory.read(there, argument.nmsgs * ctypes.sizeof(s2.i2c_msg)),
    )
    kept = []
    for message in messages:
        buffer = ctypes.cast(message.buf, ctypes.c_void_p).value or 0
        reading = bool(message.flags & READ)
        content = ctypes.create_string_buffer(bytes(message.len) if reading else memory.read(buffer, message.len))
        kept.append((buffer if reading else None, message.len, content))
        message.buf = ctypes.cast(content, ctypes.POINTER(ctypes.c_char))
    argument.msgs = messages
    result = call(argument)
    for place, count, content in kept:
        if place is not None:
            memory.write(place, content.raw[:count])
    return result
