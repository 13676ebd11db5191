"""A server on a port of this computer that serves one client at a time, step by step, without a thread."""

from __future__ import annotations

import contextlib
import socket
from abc import ABC, abstractmethod


class TcpServer(ABC):
    """Accepts a client, passes on what it sends, and sends it what is due. Nothing happens outside `serve`.

    `port` stays the same over `unplug` and `replug`. What a client does not read is kept, as far as memory goes.
    """

    def __init__(self) -> None:
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._unsent = b""
        self.sent = 0  # bytes
        self.port = 0
        self.replug()

    @abstractmethod
    def _greet(self) -> None:
        """A client has connected."""

    @abstractmethod
    def _received(self, data: bytes) -> bytes:
        """Take bytes of the client; returns the answer."""

    @abstractmethod
    def _due(self) -> bytes:
        """Bytes that became due since the last call."""

    def replug(self) -> None:
        """Listen."""
        if self._listener is None:
            self._listener = socket.create_server(("127.0.0.1", self.port))
            self._listener.setblocking(False)
            self.port = self._listener.getsockname()[1]

    def unplug(self) -> None:
        """Close the client's connection and the port."""
        self._hang_up()
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.close()

    def serve(self) -> None:
        """Accept, listen, answer, and send what is due."""
        if self._listener is not None:
            with contextlib.suppress(BlockingIOError):
                client, _ = self._listener.accept()
                self._hang_up()
                client.setblocking(False)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._client, self._unsent = client, b""
                self._greet()
        if self._client is None:
            return
        try:
            with contextlib.suppress(BlockingIOError):
                while data := self._client.recv(65536):
                    self._unsent += self._received(data)
                self._hang_up()
                return
            self._unsent += self._due()
            with contextlib.suppress(BlockingIOError):
                while self._unsent:
                    sent = self._client.send(self._unsent)
                    self._unsent = self._unsent[sent:]
                    self.sent += sent
        except OSError:
            self._hang_up()

    def inject(self, data: bytes) -> None:
        """Send these bytes next."""
        self._unsent += data

    def _hang_up(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.close()
