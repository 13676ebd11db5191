"""How many connections the web server has, and how long a client may take for its part of a request.

A client that sends nothing, or takes nothing, holds one connection for a bounded time, and gives way to others. The
bounds count from the moment at which the connection is accepted, so that they hold for the handshake of TLS too.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from collections import Counter
from contextlib import suppress
from enum import Enum, auto
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from agent.delivery.seldom import Seldom

CONNECTIONS_MAX = 200
# From so many on, the one that has waited longest for a request gives way to a new one, so that the page still answers
# while somebody opens connections and sends nothing. The others are for new ones until its socket is closed.
CROWDED = 150
HEADERS_S = 10.0  # s for the headers of a request, from the beginning of the connection or the end of the last answer
BODY_S = 30.0  # s for the body of a request
PIECE = 64 << 10  # bytes of an answer that are sent at a time
SEND_S = 20.0  # s in which a client must take a piece: 3 kB/s
SEND_BUFFER = 256 << 10  # bytes that the kernel takes of an answer; without a bound it may take some megabytes
GONE_S = 20.0  # s after which a client whose machine acknowledges nothing counts as gone
LOG_S = 60.0  # s between two lines of the log about connections, or between two equal ones of a library

Peer = tuple[str, int]  # address and port


class Deadline(Enum):
    """What a client must do in time."""

    HEADERS = auto()
    BODY = auto()
    ANSWER = auto()  # take a piece of it


_log = logging.getLogger(__name__)


class Connections:
    """Bounds the connections of the web server that serves `app`, which may be any ASGI application.

    `listening` gives the socket at which the server must listen. `ended` counts connections that were refused or
    closed. All is for one thread, that of the event loop.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.ended = 0
        self._app = app
        self._open: dict[Peer, _Connection] = {}
        # Parts for which the server waits, with the end of its patience; the one that has waited longest is first.
        self._waiting: dict[tuple[Peer, Deadline], asyncio.TimerHandle] = {}
        self._asked: Counter[Peer] = Counter()  # requests that are being answered
        self._told = Seldom(_log, LOG_S)

    def listening(self, opened: socket.socket) -> socket.socket:
        """The same listening socket, which takes no more connections than are allowed."""
        return _Listening(self, opened.detach())

    def admit(self, connection: _Connection, peer: Peer) -> bool:
        """Whether a new connection may stay; if not, it is counted."""
        if len(self._open) >= CONNECTIONS_MAX:
            self._count()
            return False
        self._open[peer] = connection
        if len(self._open) > CROWDED and self._waiting:
            self._end(next(iter(self._waiting))[0])
        self._wait(peer, Deadline.HEADERS, HEADERS_S)
        return True

    def closed(self, connection: _Connection, peer: Peer) -> None:
        """The socket of a connection is closed."""
        if self._open.get(peer) is connection:
            del self._open[peer]
            self._wait_no_more(peer, *Deadline)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request within the bounds."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        peer: Peer = tuple(scope["client"][:2])
        body_ends_s, whole = time.monotonic() + BODY_S, False

        async def receive_in_time() -> Message:
            nonlocal whole
            if not whole:  # afterwards an application waits here until the client has gone
                self._wait(peer, Deadline.BODY, body_ends_s - time.monotonic())
            message = await receive()
            self._wait_no_more(peer, Deadline.BODY)
            whole = not message.get("more_body", False)
            return message

        async def send_in_time(message: Message) -> None:
            for piece in _pieces(message):
                self._wait(peer, Deadline.ANSWER, SEND_S)
                await send(piece)
                self._wait_no_more(peer, Deadline.ANSWER)

        self._wait_no_more(peer, Deadline.HEADERS)
        self._asked[peer] += 1
        try:
            await self._app(scope, receive_in_time, send_in_time)
        finally:
            self._asked[peer] -= 1
            if not self._asked[peer]:
                del self._asked[peer]
                self._wait_no_more(peer, *Deadline)
                self._wait(peer, Deadline.HEADERS, HEADERS_S)

    def _wait(self, peer: Peer, part: Deadline, limit_s: float) -> None:
        if peer in self._open:
            self._waiting[peer, part] = asyncio.get_running_loop().call_later(limit_s, self._end, peer)

    def _wait_no_more(self, peer: Peer, *parts: Deadline) -> None:
        for part in parts:
            if (timer := self._waiting.pop((peer, part), None)) is not None:
                timer.cancel()

    def _end(self, peer: Peer) -> None:
        self._wait_no_more(peer, *Deadline)
        if peer in self._open:
            self._count()
            with suppress(OSError):  # the client was faster
                self._open[peer].shutdown(socket.SHUT_RDWR)  # what the server then sees closes the socket

    def _count(self) -> None:
        self.ended += 1
        what = "monitor: a connection was closed, because it was too slow or there were too many; %d so far"
        self._told.warning(what, self.ended)


class _Connection(socket.socket):
    """An accepted socket, which says when it is closed."""

    connections: Connections
    peer: Peer

    def close(self) -> None:
        super().close()
        self.connections.closed(self, self.peer)


class _Listening(socket.socket):
    """A listening socket that asks `connections` about each client."""

    def __init__(self, connections: Connections, fileno: int) -> None:
        super().__init__(fileno=fileno)
        self._connections = connections

    def accept(self) -> tuple[socket.socket, Any]:
        """As of every socket. Raises ConnectionAbortedError where the client is refused: the server goes on."""
        accepted, address = super().accept()
        connection = _Connection(fileno=accepted.detach())
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(GONE_S * 1000))
        connection.connections, connection.peer = self._connections, address[:2]
        if not self._connections.admit(connection, connection.peer):
            connection.close()
            raise ConnectionAbortedError("too many connections")
        return connection, address


def _pieces(message: Message) -> list[Message]:
    """A message of an answer; a long body in several, so that how fast it is taken can be seen."""
    body = message.get("body", b"")
    if len(body) <= PIECE:
        return [message]
    starts = range(0, len(body), PIECE)
    more = message.get("more_body", False)
    return [{**message, "body": body[k : k + PIECE], "more_body": more or k + PIECE < len(body)} for k in starts]


class _Seldomly(logging.Filter):
    """Lets one line of the same form pass each LOG_S: a client can cause those of a library as often as it likes."""

    def __init__(self) -> None:
        super().__init__()
        self._passed_s: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether this line passes."""
        form, now_s = str(record.msg)[:200], time.monotonic()
        if now_s - self._passed_s.get(form, -LOG_S) < LOG_S:
            return False
        self._passed_s[form] = now_s
        return True


SELDOMLY = _Seldomly()
