"""What systemd is told, by the protocol of sd_notify(3): datagrams of `KEY=value` lines to the socket it names.

Without systemd there is no socket, and nothing is sent.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import MutableMapping

FEED_FRACTION = 0.25  # of the watchdog's time; systemd advises half, and a block may come half a second late
STATUS_MAX = 400  # characters; what `systemctl status` shows in a line


class Notifier:
    """Sends notifications; none of its methods blocks or raises.

    `environment` names socket and watchdog (NOTIFY_SOCKET, WATCHDOG_USEC, WATCHDOG_PID). They are taken out of it:
    a child process is not this service.
    """

    def __init__(self, environment: MutableMapping[str, str]) -> None:
        address = environment.pop("NOTIFY_SOCKET", "")
        watchdog_us, pid = environment.pop("WATCHDOG_USEC", ""), environment.pop("WATCHDOG_PID", "")
        ours = pid in ("", str(os.getpid()))
        self.watchdog_s = int(watchdog_us) * 1e-6 if watchdog_us.isdecimal() and ours else 0.0
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address[:1] in ("/", "@") else None
        if self._socket is not None:
            self._socket.setblocking(False)
        self._fed_s = 0.0
        self._status = ""

    def ready(self) -> bool:
        """The service is up. Returns whether that was taken; else it must be said again."""
        return self._send("READY=1")

    def stopping(self) -> None:
        """The service began to end."""
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """A line for people, sent when it changes."""
        line = " ".join(text.split())[:STATUS_MAX]
        if line != self._status and self._send(f"STATUS={line}"):
            self._status = line

    def feed(self) -> None:
        """Something went through the agent; the watchdog is told so as often as it needs."""
        if not self.watchdog_s:
            return
        now_s = time.monotonic()
        if now_s - self._fed_s >= FEED_FRACTION * self.watchdog_s and self._send("WATCHDOG=1"):
            self._fed_s = now_s

    def close(self) -> None:
        """Let go of the socket."""
        if self._socket is not None:
            self._socket.close()

    def _send(self, message: str) -> bool:
        if self._socket is None:
            return True
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError:  # systemd is being started anew, or its queue is full: the next one will do
            return False
        return True
