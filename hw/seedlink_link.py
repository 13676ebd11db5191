"""A connection to a SeedLink server (protocol 3): subscription to channels of one station, then packets.

Commands and answers as in the manual of SeisComP's `seedlink`.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Iterator, Sequence

from hw.miniseed import RECORD_BYTES
from hw.sensor import Clock, ConfigurationError, DeviceLost

HEADER_BYTES = 8  # "SL" and six hexadecimal digits
PACKET_BYTES = HEADER_BYTES + RECORD_BYTES
READ_BYTES = 65536
MOST_READS = 64  # in one call: 4 MB; a server that sends faster is read in the next call
ANSWER_S, POLL_S = 5.0, 0.01
LONGEST_ANSWER = 1024  # bytes
# A connection that says nothing is asked by the kernel whether it is still there: after 10 s, then three times.
KEEP_ALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}


class SeedLinkConnection:
    """One connection. `where` names the station and the server in messages."""

    def __init__(self, where: str, clock: Clock, sleep: Callable[[float], None]) -> None:
        self._where = where
        self._clock = clock
        self._sleep = sleep
        self._socket: socket.socket | None = None
        self._data = b""

    def connect(self, host: str, port: int, station: str, network: str, selectors: Sequence[str]) -> str:
        """Subscribe to the channels and start the stream; returns how the server names itself.

        Raises DeviceLost, or ConfigurationError where the server refuses a station or a channel.
        """
        self._data = b""
        try:
            self._socket = socket.create_connection((host, port), timeout=ANSWER_S)
        except OSError as error:
            raise DeviceLost(f"{self._where}: {error}") from error
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in KEEP_ALIVE.items():
            self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
        server = self._ask("HELLO", lines=2)[0]
        for command in (f"STATION {station} {network}", *(f"SELECT {selector}" for selector in selectors), "DATA"):
            answer = self._ask(command)[0]
            if answer != "OK":
                raise ConfigurationError(f"{self._where}: the server answered {answer!r} to {command!r}")
        self._send("END")
        return server

    def close(self) -> None:
        """Say goodbye and release the connection."""
        held, self._socket = self._socket, None
        if held is not None:
            with contextlib.suppress(OSError):
                held.send(b"BYE\r\n")
            held.close()

    def records(self) -> Iterator[bytes]:
        """The records that have come, RECORD_BYTES each; waits for none. Raises DeviceLost."""
        for _ in range(MOST_READS):
            came = self._read()
            whole = len(self._data) // PACKET_BYTES * PACKET_BYTES
            for begin in range(0, whole, PACKET_BYTES):
                header = self._data[begin : begin + HEADER_BYTES]
                if not header.startswith(b"SL"):
                    raise DeviceLost(f"{self._where}: {header!r} is not the header of a SeedLink packet")
                if not header.startswith(b"SLINFO"):
                    yield self._data[begin + HEADER_BYTES : begin + PACKET_BYTES]
            self._data = self._data[whole:]
            if not came:
                return

    def _read(self) -> bool:
        """Add what has come to the data; False if nothing came."""
        assert self._socket is not None
        try:
            data = self._socket.recv(READ_BYTES)
        except BlockingIOError:
            return False
        except OSError as error:
            raise DeviceLost(f"{self._where}: {error}") from error
        if not data:
            raise DeviceLost(f"{self._where}: the server closed the connection")
        self._data += data
        return True

    def _send(self, command: str) -> None:
        assert self._socket is not None
        try:
            self._socket.sendall(command.encode("ascii") + b"\r\n")
        except OSError as error:
            raise DeviceLost(f"{self._where}: {error}") from error

    def _ask(self, command: str, lines: int = 1) -> list[str]:
        """Send a command and return the lines of the answer."""
        self._send(command)
        latest_ns = self._clock()[0] + round(ANSWER_S * 1e9)
        while self._data.count(b"\n") < lines:
            if self._clock()[0] > latest_ns or len(self._data) > LONGEST_ANSWER:
                raise DeviceLost(f"{self._where}: no answer to {command!r} as SeedLink servers give it")
            self._sleep(POLL_S)
            self._read()
        *answer, self._data = self._data.split(b"\n", lines)
        return [line.strip().decode("ascii", "replace") for line in answer]
