"""A Raspberry Shake that counts its samples and sends them over UDP to a port of this computer."""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray


def datagram(channel: str, start_ns: int, samples: NDArray[np.int32]) -> bytes:
    """A datagram as a Shake writes it: the time with milliseconds."""
    counts = "".join(f", {count}" for count in samples.tolist())
    return f"{{'{channel}', {start_ns // 10**6 / 1e3:.3f}{counts}}}".encode("ascii")


class ShakeTwin:
    """Sends datagrams of `samples` samples of each channel as they become due; the next one is number `next`.

    `values(first, n)` returns (n, channels) counts; `due()` is the number of samples that exist; sample k was taken at
    `epoch_ns` + k / rate (UTC). Nothing arrives while it is not `plugged`.
    """

    def __init__(
        self,
        channels: Sequence[str],
        values: Callable[[int, int], NDArray[np.int32]],
        due: Callable[[], int],
        rate_hz: float,
        epoch_ns: int,
        samples: int = 25,
    ) -> None:
        self._channels = channels
        self._values = values
        self._due = due
        self._rate_hz = rate_hz
        self._epoch_ns = epoch_ns
        self._samples = samples
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.port: int = free.getsockname()[1]
        self.next = 0
        self.plugged = True

    def close(self) -> None:
        """End."""
        self._socket.close()

    def start_ns(self, number: int) -> int:
        """UTC of a sample."""
        return self._epoch_ns + round(number * 1e9 / self._rate_hz)

    def datagrams(self, first: int) -> list[bytes]:
        """Those that begin with a sample, by channel."""
        values = self._values(first, self._samples)
        return [datagram(name, self.start_ns(first), values[:, k]) for k, name in enumerate(self._channels)]

    def serve(self) -> None:
        """Send what is due."""
        while self._due() - self.next >= self._samples:
            if self.plugged:
                for data in self.datagrams(self.next):
                    self.send(data)
            self.next += self._samples

    def send(self, data: bytes, source: str = "127.0.0.1") -> None:
        """Send a datagram now, from an address of this computer."""
        if source == "127.0.0.1":
            self._socket.sendto(data, ("127.0.0.1", self.port))
            return
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind((source, 0))
            other.sendto(data, ("127.0.0.1", self.port))
