"""Targets of an I2C bus in another process: the adapter on one side of a socket, its twins on the other.

A transfer is one request (number of messages; each an address, 1 for a read, a length, what is to be written) and one
answer (errno, 0 when all went well, then what was read).
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
import threading
from pathlib import Path

from hw.virtual.kernel import I2CBus

_COUNT, _MESSAGE, _RESULT = struct.Struct("<B"), struct.Struct("<BBH"), struct.Struct("<i")


class RemoteBus(I2CBus):
    """For `installed`: an adapter whose targets `serve` answers for, at `path`."""

    def __init__(self, path: Path) -> None:
        super().__init__({})
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(str(path))
        self._turn = threading.Lock()

    def close(self) -> None:
        """Let go of the other side."""
        self._socket.close()

    def transfer(self, messages: list[tuple[int, int | bytes]]) -> list[bytes | None]:
        """As every bus does it."""
        request = bytearray(_COUNT.pack(len(messages)))
        for address, content in messages:
            reading = isinstance(content, int)
            request += _MESSAGE.pack(address, reading, content if isinstance(content, int) else len(content))
            request += b"" if isinstance(content, int) else content
        with self._turn:
            self._socket.sendall(request)
            (number,) = _RESULT.unpack(_receive(self._socket, _RESULT.size))
            if number:
                raise OSError(number, os.strerror(number))
            lengths = [content if isinstance(content, int) else None for _, content in messages]
            return [None if length is None else _receive(self._socket, length) for length in lengths]


def serve(bus: I2CBus, path: Path) -> None:
    """Answer for the bus's targets, from a thread, as long as the process lives."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()
    threading.Thread(target=_accept, args=(listener, bus), name=f"bus {path}", daemon=True).start()


def _accept(listener: socket.socket, bus: I2CBus) -> None:
    while True:
        connection, _ = listener.accept()
        threading.Thread(target=_answer, args=(connection, bus), daemon=True).start()


def _answer(connection: socket.socket, bus: I2CBus) -> None:
    with connection, contextlib.suppress(OSError):  # the other side is gone
        while True:
            (count,) = _COUNT.unpack(_receive(connection, _COUNT.size))
            messages: list[tuple[int, int | bytes]] = []
            for _ in range(count):
                address, reading, length = _MESSAGE.unpack(_receive(connection, _MESSAGE.size))
                messages.append((address, length if reading else _receive(connection, length)))
            connection.sendall(_carried_out(bus, messages))


def _carried_out(bus: I2CBus, messages: list[tuple[int, int | bytes]]) -> bytes:
    try:
        read = bus.transfer(messages)
    except OSError as error:
        return _RESULT.pack(error.errno or errno.EIO)
    return _RESULT.pack(0) + b"".join(part for part in read if part is not None)


def _receive(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        data += part
    return data
