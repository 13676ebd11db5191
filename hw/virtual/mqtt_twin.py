"""An MQTT 5 broker with one publisher, which counts its samples; for tests. OASIS MQTT 5.0, chapters 2 and 3."""

from __future__ import annotations

import struct
from collections.abc import Callable

from hw.virtual.tcp_server import TcpServer

CONNECT, CONNACK, PUBLISH, SUBSCRIBE, SUBACK, PINGREQ, PINGRESP = 1, 2, 3, 8, 9, 12, 13
NOT_AUTHORIZED = 0x87


class MqttTwin(TcpServer):
    """Sends messages of `samples` samples as they become due; the next one begins with sample `next`.

    `payload(first, n)` makes the payload of a message; `due()` is the number of samples that exist. `refuses` are the
    requests (CONNECT, SUBSCRIBE) that are refused.
    """

    def __init__(
        self, topic: str, payload: Callable[[int, int], bytes], due: Callable[[], int], samples: int = 100
    ) -> None:
        self.topic = topic
        self._payload = payload
        self._due_samples = due
        self._samples = samples
        self.next = 0
        self.refuses: set[int] = set()
        self._streaming = False
        super().__init__()

    def publish(self, payload: bytes, *, topic: str | None = None, retain: bool = False) -> None:
        """Send this message next."""
        self.inject(_message(topic or self.topic, payload, retain))

    def _greet(self) -> None:
        self._streaming = False
        self._bytes = b""

    def _received(self, data: bytes) -> bytes:
        self._bytes += data
        answers = b""
        while (packet := self._packet()) is not None:
            answers += self._answer(*packet)
        return answers

    def _packet(self) -> tuple[int, bytes] | None:
        length = shift = 0
        for at, byte in enumerate(self._bytes[1:5], 2):
            length |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                if len(self._bytes) < at + length:
                    return None
                kind, body = self._bytes[0] >> 4, self._bytes[at : at + length]
                self._bytes = self._bytes[at + length :]
                return kind, body
        return None

    def _answer(self, kind: int, body: bytes) -> bytes:
        code = NOT_AUTHORIZED if kind in self.refuses else 0
        if kind == CONNECT:
            return _packed(CONNACK, bytes([0, code, 0]))
        if kind == SUBSCRIBE:
            self._streaming = not code
            self.next = self._due_samples()
            return _packed(SUBACK, body[:2] + bytes([0, code]))
        return _packed(PINGRESP, b"") if kind == PINGREQ else b""

    def _due(self) -> bytes:
        sent = b""
        while self._streaming and self._due_samples() - self.next >= self._samples:
            sent += _message(self.topic, self._payload(self.next, self._samples), retain=False)
            self.next += self._samples
        return sent


def _message(topic: str, payload: bytes, retain: bool) -> bytes:
    name = topic.encode("utf-8")
    return _packed(PUBLISH, struct.pack(">H", len(name)) + name + b"\0" + payload, int(retain))


def _packed(kind: int, body: bytes, flags: int = 0) -> bytes:
    length, size = b"", len(body)
    while size >= 0x80:
        length += bytes([size & 0x7F | 0x80])
        size >>= 7
    return bytes([kind << 4 | flags]) + length + bytes([size]) + body
