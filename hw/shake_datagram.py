"""Decodes the datagrams of a Raspberry Shake: one channel each, as `{'EHZ', 1582315130.292, 14168, 14927}`.

Channel, UTC of the first sample in s since 1970, counts; in ASCII (rsudp: rsudp/raspberryshake.py, getCHN, getTIME,
getSTREAM; rsudp/packetize.py writes them with milliseconds and ends each with a new line).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_DATAGRAM = re.compile(rb"\{'([A-Z0-9]{3})', *(\d{1,10})(?:\.(\d{1,9}))?((?:, *-?\d{1,10})+)\}\s{0,2}", re.ASCII)
_INT32 = np.iinfo(np.int32)


class DatagramError(Exception):
    """Bytes that are no datagram of a Raspberry Shake."""


@dataclass(frozen=True, slots=True, eq=False)
class Datagram:
    """Samples (n,) of one channel; `start_ns` is UTC of the first one."""

    channel: str
    start_ns: int
    samples: NDArray[np.int32]


def decode(data: bytes) -> Datagram:
    """Decode one datagram. Raises DatagramError, and nothing else, whatever the bytes are."""
    found = _DATAGRAM.fullmatch(data)
    if found is None:
        raise DatagramError("the text is not {'channel', time, count, count, ...}")
    channel, seconds, fraction, counts = found.groups()
    samples = np.array(counts.split(b",")[1:], np.int64)
    if samples.max() > _INT32.max or samples.min() < _INT32.min:
        raise DatagramError("a count of more than 32 bits")
    start_ns = int(seconds) * 10**9 + int((fraction or b"").ljust(9, b"0"))
    return Datagram(channel.decode("ascii"), start_ns, samples.astype(np.int32))
