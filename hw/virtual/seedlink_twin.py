"""A SeedLink server (protocol 3) with one station, which counts its samples; for tests and demonstrations."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from hw.miniseed import RECORD_BYTES, TIME_CORRECTED
from hw.virtual.tcp_server import TcpServer

INT32 = 3
DATA_AT = 64


def record(channel: str, start_ns: int, rate_hz: int, samples: NDArray[np.int32], number: int = 1) -> bytes:
    """A record of miniSEED 2 with 32-bit samples (n,); `channel` is NETWORK.STATION.LOCATION.CHANNEL."""
    network, station, location, name = channel.split(".")
    names = f"{station:<5}{location:<2}{name:<3}{network:<2}".encode("ascii")
    start = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=start_ns // 1000)
    fraction, microseconds = divmod(start.microsecond, 100)
    header = b"%06dD " % (number % 10**6) + names
    header += struct.pack(
        ">HHBBBxHH",
        start.year,
        start.timetuple().tm_yday,
        start.hour,
        start.minute,
        start.second,
        fraction,
        len(samples),
    )
    header += struct.pack(">hhBBBBiHH", rate_hz, 1, TIME_CORRECTED, 0, 0, 2, 0, DATA_AT, 48)
    header += struct.pack(">HHBBBx", 1000, 56, INT32, 1, 9) + struct.pack(">HHBbBB", 1001, 0, 100, microseconds, 0, 0)
    return (header + samples.astype(">i4").tobytes()).ljust(RECORD_BYTES, b"\0")


class SeedLinkTwin(TcpServer):
    """Sends records of `samples` samples of each channel as they become due; the next one is number `next`.

    `values(first, n)` returns (n, channels) counts; `due()` is the number of samples that exist; sample k was taken at
    `epoch_ns` + k / rate (UTC). The server refuses other stations and channels.
    """

    def __init__(
        self,
        channels: Sequence[str],
        values: Callable[[int, int], NDArray[np.int32]],
        due: Callable[[], int],
        rate_hz: int,
        epoch_ns: int,
        samples: int = 100,
    ) -> None:
        self._channels = channels
        self._values = values
        self._due_samples = due
        self._rate_hz = rate_hz
        self._epoch_ns = epoch_ns
        self._samples = samples
        self._number = 0
        self.next = 0
        self.streaming = False
        super().__init__()

    def packet(self, data: bytes) -> bytes:
        """A packet of the stream with this record."""
        self._number += 1
        return b"SL%06X" % (self._number % 0x1000000) + data

    def _greet(self) -> None:
        self.streaming = False
        self._commands = b""

    def _received(self, data: bytes) -> bytes:
        *lines, self._commands = re.split(rb"[\r\n]+", self._commands + data)
        return b"".join(self._answer(line.decode("ascii", "replace")) for line in lines if line)

    def _answer(self, line: str) -> bytes:
        command, argument = line.split()[0], " ".join(line.split()[1:])
        if command == "HELLO":
            return b"SeedLink v3.1 (2020.075)\r\nTwin of fieldcal\r\n"
        if command == "END":
            self.streaming = True
            self.next = self._due_samples()
            return b""
        network, station, location, _ = self._channels[0].split(".")
        known = {"STATION": [f"{station} {network}"], "DATA": [""]}
        codes = [channel.rpartition(".")[2] for channel in self._channels]
        known["SELECT"] = [f"{place}{code}{kind}" for place in ("", location) for code in codes for kind in ("", ".D")]
        return b"OK\r\n" if argument in known.get(command, ()) else b"ERROR\r\n"

    def _due(self) -> bytes:
        packets = []
        while self.streaming and self._due_samples() - self.next >= self._samples:
            values = self._values(self.next, self._samples)
            start_ns = self._epoch_ns + round(self.next * 1e9 / self._rate_hz)
            packets += [
                self.packet(record(channel, start_ns, self._rate_hz, values[:, k], self._number))
                for k, channel in enumerate(self._channels)
            ]
            self.next += self._samples
        return b"".join(packets)
