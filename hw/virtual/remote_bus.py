"""Targets of an I2C bus in another process: the adapter is on one side of a socket, its twins on the other.

A transfer is one packet in each direction. Request: the messages (address, 1 for a read, length, bytes to write).
Answer: errno (0 for success) and the bytes read. There is one packet per transfer, like one ioctl, because each packet
costs a wait for the interpreter.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
import threading
from pathlib import Path

from hw.virtual.kernel import MAX_MESSAGE_BYTES, I2CBus

_MESSAGE, _RESULT = struct.Struct("<BBH"), struct.Struct("<i")
_PACKET_BYTES = 4 * MAX_MESSAGE_BYTES  # larger than any request of a driver


class RemoteBus(I2CBus):
    """An adapter for `installed`; the function `serve` answers for its targets at `path`."""

    def __init__(self, path: Path) -> None:
        super().__init__({})
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.connect(str(path))
        self._turn = threading.Lock()

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def transfer(self, messages: list[tuple[int, int | bytes]]) -> list[bytes | None]:
        """Do all messages, like every bus."""
        request = b""
        for address, content in messages:
            if isinstance(content, int):
                request += _MESSAGE.pack(address, 1, content)
            else:
                request += _MESSAGE.pack(address, 0, len(content)) + content
        with self._turn:
            self._socket.sendall(request)
            answer = self._socket.recv(_PACKET_BYTES)
        # An empty answer: the other side is gone
        (number,) = _RESULT.unpack_from(answer) if answer else (errno.ENODEV,)
        if number:
            raise OSError(number, os.strerror(number))
        read: list[bytes | None] = []
        at = _RESULT.size
        for _, content in messages:
            if isinstance(content, int):
                read.append(answer[at : at + content])
                at += content
            else:
                read.append(None)
        return read


def serve(bus: I2CBus, path: Path) -> None:
    """Answer requests for the bus's targets from a thread, until the process ends."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(str(path))
    listener.listen()
    threading.Thread(target=_accept, args=(listener, bus), name=f"bus {path}", daemon=True).start()


def _accept(listener: socket.socket, bus: I2CBus) -> None:
    while True:
        connection, _ = listener.accept()
        threading.Thread(target=_answer, args=(connection, bus), daemon=True).start()


def _answer(connection: socket.socket, bus: I2CBus) -> None:
    with connection, contextlib.suppress(OSError):  # the other side is gone
        while request := connection.recv(_PACKET_BYTES):
            try:
                read = bus.transfer(_messages(request))
            except OSError as error:
                connection.sendall(_RESULT.pack(error.errno or errno.EIO))
            else:
                connection.sendall(_RESULT.pack(0) + b"".join(part for part in read if part is not None))


def _messages(request: bytes) -> list[tuple[int, int | bytes]]:
    messages: list[tuple[int, int | bytes]] = []
    at = 0
    while at < len(request):
        address, reading, length = _MESSAGE.unpack_from(request, at)
        at += _MESSAGE.size
        messages.append((address, length if reading else request[at : at + length]))
        at += 0 if reading else length
    return messages
