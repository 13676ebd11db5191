"""Commands sent on the gateway itself, through a socket in the data directory: same bytes and checks as over Zenoh.

The agent sends `<site>/<gateway>` in a line. The sender then sends `<sensor>/command/<verb>` in a line and the bytes of
the command, and shuts down its sending side. The agent answers in JSON.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self

from agent.commanding.desk import CommandDesk
from agent.commanding.envelope import LARGEST

SOCKET_NAME = "commands.sock"
ANSWER_S = 5.0  # s; the agent answers after one fsync
SENDER_S = 2.0  # s in which a sender must have sent the whole command
LINE_MAX = 256  # bytes; two names of up to 63 and what is between them


class LocalDoor:
    """Listens on a socket in a data directory and serves one command after the other, until closed. Raises OSError."""

    def __init__(self, data_dir: Path, gateway: str, desk: CommandDesk) -> None:
        self._gateway = gateway
        self._desk = desk
        self._path = data_dir / SOCKET_NAME
        self._path.unlink(
            missing_ok=True
        )  # left by a killed run; no other run can use it: it would hold the store's lock
        self._socket = socket.socket(socket.AF_UNIX)
        with _short(data_dir) as directory:
            self._socket.bind(f"{directory}/{SOCKET_NAME}")
        self._path.chmod(0o660)
        self._socket.listen(4)
        threading.Thread(target=self._serve, name="local commands", daemon=True).start()

    def close(self) -> None:
        """Stop listening."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # close alone would not wake the thread that waits in `accept`
        self._socket.close()
        self._path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            with connection, suppress(OSError):
                connection.settimeout(SENDER_S)
                connection.sendall(self._gateway.encode() + b"\n")
                said = _read(connection, LINE_MAX + LARGEST + 1, SENDER_S)
                address, _, data = said.partition(b"\n")
                connection.sendall(self._desk.receive(address.decode(errors="replace"), data).json)


class LocalAgent:
    """A connection to the agent that uses a data directory; `gateway` is its `<site>/<gateway>`.

    Raises ConnectionError where no agent accepts commands there.
    """

    def __init__(self, data_dir: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(ANSWER_S)
        try:
            with _short(data_dir) as directory:
                self._socket.connect(f"{directory}/{SOCKET_NAME}")
            line = b""
            while not line.endswith(b"\n") and len(line) < LINE_MAX:
                if not (byte := self._socket.recv(1)):
                    break
                line += byte
        except OSError as error:
            self._socket.close()
            raise ConnectionError(
                f"{data_dir}: no agent takes commands here: {error.strerror or error}; "
                f"is the agent running, and is commands.enabled set in its configuration?"
            ) from None
        self.gateway = line.decode(errors="replace").strip()

    def send(self, address: str, data: bytes) -> bytes:
        """Send a command to `address` (`<sensor>/command/<verb>`) and return the answer. Raises OSError."""
        self._socket.sendall(address.encode() + b"\n" + data)
        self._socket.shutdown(socket.SHUT_WR)
        return _read(self._socket, LARGEST, ANSWER_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()


@contextmanager
def _short(directory: Path) -> Iterator[str]:
    # The address of a socket is limited to 107 bytes; a path may be longer.
    descriptor = os.open(directory, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{descriptor}"
    finally:
        os.close(descriptor)


def _read(connection: socket.socket, most: int, timeout_s: float) -> bytes:
    """Read to the end, or `most` bytes if more come. Raises TimeoutError after `timeout_s`."""
    end_s = time.monotonic() + timeout_s
    said = b""
    while len(said) < most:
        if (left_s := end_s - time.monotonic()) <= 0:
            raise TimeoutError
        connection.settimeout(left_s)
        part = connection.recv(most - len(said))
        if not part:
            break
        said += part
    return said
