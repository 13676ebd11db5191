"""A relay before a router, some of whose links are deaf: the router has agreed to them, and does not read them.

This is what a router of Zenoh 1.10 leaves where its time to accept a link ends too late (agent.delivery.hearing). The
relay lets the handshake through, then drops what both sides send, and sends signs of life to the client.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from contextlib import suppress

HANDSHAKE = 2  # messages of each side: InitSyn and OpenSyn, InitAck and OpenAck
KEEP_ALIVE = b"\x01\x00\x04"  # length, then the identifier of the message
KEEP_ALIVE_S = 0.5


class Relay:
    """Relays from `endpoint` to the router at the endpoint `router`. The first `deaf` links are deaf.

    `accepted_s`: the monotonic time of each link.
    """

    def __init__(self, router: str, deaf: int) -> None:
        self._router = int(router.rsplit(":", 1)[1])
        self._deaf = deaf
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open: list[socket.socket] = [self._listener]
        self._closed = threading.Event()
        self.accepted_s: list[float] = []
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """End all links."""
        self._closed.set()
        for opened in self._open:
            with suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)
            opened.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                router = socket.create_connection(("127.0.0.1", self._router))
                self._open += [client, router]
                deaf = len(self.accepted_s) < self._deaf
                self.accepted_s.append(time.monotonic())
                for source, target in ((client, router), (router, client)):
                    threading.Thread(target=self._relay, args=(source, target, deaf), daemon=True).start()
                if deaf:
                    threading.Thread(target=self._keep_alive, args=(client,), daemon=True).start()

    def _relay(self, source: socket.socket, target: socket.socket, deaf: bool) -> None:
        with suppress(OSError, struct.error):
            for _ in range(HANDSHAKE):
                head = source.recv(2, socket.MSG_WAITALL)
                (length,) = struct.unpack("<H", head)
                target.sendall(head + source.recv(length, socket.MSG_WAITALL))
            while data := source.recv(1 << 16):
                if not deaf:
                    target.sendall(data)
        if not deaf:
            target.close()

    def _keep_alive(self, client: socket.socket) -> None:
        with suppress(OSError):
            while not self._closed.wait(KEEP_ALIVE_S):
                client.sendall(KEEP_ALIVE)
