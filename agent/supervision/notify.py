"""Notifications to systemd, by the protocol of sd_notify(3): datagrams of `KEY=value` lines to a socket.

systemd names the socket in the environment. Without systemd nothing is sent.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import MutableMapping

FEED_FRACTION = 0.25  # of the watchdog's time between two messages; systemd advises 0.5, but a block may be 0.5 s late
STATUS_MAX = 400  # characters that `systemctl status` shows in a line


class SystemdNotifier:
    """Sends notifications; none of its methods blocks or raises.

    `environment`: has the socket and the watchdog's time (NOTIFY_SOCKET, WATCHDOG_USEC, WATCHDOG_PID). These variables
    are removed from it, so that no child process sends notifications in the name of this service.
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
        """Report that the service has started. Returns whether systemd got the message; if False, call again later."""
        return self._send("READY=1")

    def stopping(self) -> None:
        """Report that the service is stopping."""
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """Set the line of text that `systemctl status` shows. It is sent only when it changes."""
        line = " ".join(text.split())[:STATUS_MAX]
        if line != self._status and self._send(f"STATUS={line}"):
            self._status = line

    def feed(self) -> None:
        """Report that the agent works: call it for each block. The watchdog gets a message as often as it needs one."""
        if not self.watchdog_s:
            return
        now_s = time.monotonic()
        if now_s - self._fed_s >= FEED_FRACTION * self.watchdog_s and self._send("WATCHDOG=1"):
            self._fed_s = now_s

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()

    def _send(self, message: str) -> bool:
        if self._socket is None:
            return True
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError:  # systemd restarts, or its queue is full: the next message serves as well
            return False
        return True
