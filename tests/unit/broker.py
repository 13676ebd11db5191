"""Debian's mosquitto on loopback, which can be killed and comes back at the same port, and what it forwards."""

from __future__ import annotations

import shutil
import socket
import subprocess
from pathlib import Path
from typing import Any, Self

import pytest

from tests.unit.zenoh_site import wait_for

MOSQUITTO = shutil.which("mosquitto")
needs_mosquitto = pytest.mark.skipif(MOSQUITTO is None, reason="needs Debian's mosquitto")
OPEN = "allow_anonymous true\n"


def free_port() -> int:
    """A port at which nothing listens."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


class Broker:
    """A broker with these lines of configuration. It keeps nothing over a restart."""

    def __init__(self, directory: Path, lines: str = OPEN) -> None:
        self.port = free_port()
        self._config = directory / f"mosquitto-{self.port}.conf"
        self._config.write_text(f"listener {self.port} 127.0.0.1\nuser root\n{lines}")
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> Self:
        """Start it, and wait until it listens."""
        self.process = subprocess.Popen(["mosquitto", "-c", self._config], stderr=subprocess.DEVNULL)
        wait_for(self._listens)
        return self

    def _listens(self) -> bool:
        try:
            socket.create_connection(("127.0.0.1", self.port), 1).close()
        except OSError:
            return False
        return True

    def kill(self) -> None:
        """End it as a power cut does."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()


class Subscriber:
    """All that a broker forwards: (topic, value, whether it was retained), in order."""

    def __init__(self, broker: Broker, topic: str = "#") -> None:
        paho = pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed (extra mqtt)")
        self.came: list[tuple[str, bytes, bool]] = []
        self._client: Any = paho.Client(paho.CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
        self._client.on_message = lambda *given: self._take(given[2])
        subscribed: list[Any] = []
        self._client.on_connect = lambda c, *_: c.subscribe(topic, 1)
        self._client.on_subscribe = lambda *_: subscribed.append(1)
        self._client.connect("127.0.0.1", broker.port)
        self._client.loop_start()
        wait_for(lambda: bool(subscribed))

    def _take(self, message: Any) -> None:
        self.came.append((message.topic, message.payload, message.retain))

    def of(self, topic: str) -> list[bytes]:
        """The values of one topic."""
        return [value for name, value, _ in self.came if name == topic]

    def close(self) -> None:
        """Leave."""
        self._client.disconnect()
        self._client.loop_stop()
