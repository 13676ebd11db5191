"""An i2c-tiny-usb adapter for a virtual machine: a USB device in this process, connected by QEMU's USB redirection.

The device has three vendor requests (Linux, drivers/i2c/busses/i2c-tiny-usb.c). Redirection uses the usbredir protocol
0.7 with 64-bit ids (spice, usbredir/docs/usb-redirection-protocol.md): packets of type, length, id and content. This
side describes the device and then answers control transfers.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from enum import IntEnum
from pathlib import Path

from hw.virtual.kernel import READ, I2CBus

VENDOR, PRODUCT = 0x0403, 0xC631
FULL_SPEED, VENDOR_CLASS, NO_ENDPOINT = 1, 0xFF, 255
PACKET_BYTES = 64
CAPABILITIES = 1 << 4 | 1 << 5 | 1 << 6  # packet sizes, 64-bit ids, long bulk transfers: QEMU requires them for XHCI
HELLO_HEAD, HEAD = struct.Struct("<III"), struct.Struct("<IIQ")
CONTROL = struct.Struct("<BBBBHHH")  # endpoint, request, its type, status, value, index, length
SUCCESS, STALL = 0, 4
TO_HOST, STANDARD = 0x80, 0x00  # in the type of a request; bits 6:5 tell standard from vendor requests
GET_DESCRIPTOR, GET_FUNCTIONS, SET_DELAY, GET_STATUS, TRANSFERS = 6, 1, 2, 3, range(4, 8)
ACKNOWLEDGED, NOT_ACKNOWLEDGED = b"\x01", b"\x02"


class Packet(IntEnum):
    """Kinds of packets that are used here."""

    HELLO = 0
    CONNECT = 1
    DISCONNECT = 2
    INTERFACES = 4
    ENDPOINTS = 5
    SET_CONFIGURATION = 6
    GET_CONFIGURATION = 7
    CONFIGURATION = 8
    SET_ALTERNATE = 9
    GET_ALTERNATE = 10
    ALTERNATE = 11
    CONTROL = 100


def _text(text: str) -> bytes:
    content = text.encode("utf-16le")
    return bytes([2 + len(content), 3]) + content


DESCRIPTORS = {
    0x0100: struct.pack(
        "<BBHBBBBHHHBBBB", 18, 1, 0x0110, VENDOR_CLASS, 0, 0, PACKET_BYTES, VENDOR, PRODUCT, 0x0105, 1, 2, 0, 1
    ),
    0x0200: bytes([9, 2, 18, 0, 1, 1, 0, 0x80, 50, 9, 4, 0, 0, 0, VENDOR_CLASS, 0, 0, 0]),
    0x0300: bytes([4, 3, 9, 4]),
    0x0301: _text("fieldcal"),
    0x0302: _text("i2c-tiny-usb"),
}


class TinyUsb:
    """Context manager: listens at `path` for QEMU; the device is plugged in from the start."""

    def __init__(self, bus: I2CBus, path: Path) -> None:
        self._bus = bus
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        self._peer: socket.socket | None = None
        self._status = ACKNOWLEDGED
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> TinyUsb:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        for end in (self._listener, self._peer):
            if end is not None:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
                end.close()
        self._thread.join()

    def plug(self) -> None:
        """Plug the device in."""
        self._send(Packet.INTERFACES, struct.pack("<I", 1) + bytes(32) + bytes([VENDOR_CLASS, *bytes(31)]) + bytes(64))
        ends = bytes([0, *[NO_ENDPOINT] * 15]) * 2  # the control endpoint, out and in
        self._send(Packet.ENDPOINTS, ends + bytes(64) + struct.pack("<H", PACKET_BYTES) * 32)
        self._send(Packet.CONNECT, struct.pack("<BBBBHH", FULL_SPEED, VENDOR_CLASS, 0, 0, VENDOR, PRODUCT))

    def unplug(self) -> None:
        """Unplug the device."""
        self._send(Packet.DISCONNECT, b"")

    def _run(self) -> None:
        with contextlib.suppress(OSError, EOFError):
            self._peer, _ = self._listener.accept()
            self._peer.sendall(HELLO_HEAD.pack(Packet.HELLO, 68, 0) + b"fieldcal".ljust(64, b"\0"))
            self._peer.sendall(struct.pack("<I", CAPABILITIES))
            self._receive(HELLO_HEAD.unpack(self._receive(HELLO_HEAD.size))[1])
            self.plug()
            while True:
                kind, length, number = HEAD.unpack(self._receive(HEAD.size))
                self._answer(kind, number, self._receive(length))

    def _answer(self, kind: int, number: int, content: bytes) -> None:
        match kind:
            case Packet.SET_CONFIGURATION | Packet.GET_CONFIGURATION:
                self._send(Packet.CONFIGURATION, bytes([SUCCESS, 1]), number)
            case Packet.SET_ALTERNATE | Packet.GET_ALTERNATE:
                self._send(Packet.ALTERNATE, bytes([SUCCESS, content[0], 0]), number)
            case Packet.CONTROL:
                endpoint, request, kind_of_request, _, value, index, length = CONTROL.unpack_from(content)
                data = self._control(request, kind_of_request, value, index, length, content[CONTROL.size :])
                status = STALL if data is None else SUCCESS
                sent = data or b""
                if kind_of_request & TO_HOST:
                    length = len(sent)
                head = CONTROL.pack(endpoint, request, kind_of_request, status, value, index, length)
                self._send(Packet.CONTROL, head + (sent if kind_of_request & TO_HOST else b""), number)

    def _control(self, request: int, kind: int, value: int, index: int, length: int, data: bytes) -> bytes | None:
        """The answer, or None for a request that is not supported."""
        if kind & 0x60 == STANDARD:
            if request == GET_DESCRIPTOR:
                descriptor = DESCRIPTORS.get(value)
                return None if descriptor is None else descriptor[:length]
            return bytes(2)[:length] if kind & TO_HOST else b""
        if request == GET_FUNCTIONS:
            return struct.pack("<I", self._bus.adapter.functions)
        if request == SET_DELAY:
            return b""
        if request == GET_STATUS:
            return self._status
        if request in TRANSFERS:
            return self._transfer(index, length if value & READ else data)
        return None

    def _transfer(self, address: int, message: int | bytes) -> bytes:
        """Do one I2C message; another request asks whether it was acknowledged."""
        try:
            (read,) = self._bus.transfer([(address, message)])
        except OSError:
            self._status = NOT_ACKNOWLEDGED
            return bytes(message) if isinstance(message, int) else b""
        self._status = ACKNOWLEDGED
        return read or b""

    def _send(self, kind: int, content: bytes, number: int = 0) -> None:
        if self._peer is not None:
            self._peer.sendall(HEAD.pack(kind, len(content), number) + content)

    def _receive(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self._peer.recv(count - len(data)) if self._peer else b""
            if not part:
                raise EOFError
            data += part
        return data
