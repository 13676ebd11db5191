"""A rig for drivers that connect to a server, on a twin of the server at a port of this computer."""

from __future__ import annotations

import fcntl
import socket
import struct
import termios
import time
from abc import abstractmethod

from hw.block import DeviceInfo
from hw.conformance.sensor import Rig
from hw.message_sensor import MessageSensor
from hw.virtual.tcp_server import TcpServer


class NetworkRig(Rig):
    """A subclass has the twin `server` and builds the driver."""

    server: TcpServer
    sensor: MessageSensor

    @abstractmethod
    def socket(self) -> socket.socket | None:
        """The driver's socket, to see what waits there."""

    def sleep(self, seconds: float) -> None:
        """Move the clock; the server answers and sends, and the bytes arrive."""
        super().sleep(seconds)
        before, sent = self.waiting(), self.server.sent
        self.server.serve()
        wanted = before + self.server.sent - sent
        deadline = time.monotonic() + 5.0
        while self.socket() is not None and self.waiting() < wanted and time.monotonic() < deadline:
            pass  # the kernel passes the bytes on within microseconds

    def waiting(self) -> int:
        """Number of bytes that wait for the driver."""
        held = self.socket()
        if held is None:
            return 0
        return int(struct.unpack("I", fcntl.ioctl(held.fileno(), termios.FIONREAD, b"\0\0\0\0"))[0])

    def open(self) -> DeviceInfo:
        return self.sensor.open()

    def unplug(self) -> None:
        self.server.unplug()

    def replug(self) -> None:
        self.server.replug()

    def close(self) -> None:
        self.sensor.close()
        self.server.unplug()
