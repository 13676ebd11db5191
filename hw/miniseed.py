"""Decodes records of miniSEED 2, with 512 bytes each, as SeedLink sends them.

SEED Reference Manual 2.4 (FDSN 2012): chapter 8 (fixed header, blockettes 1000 and 1001), appendix B (Steim 1 and 2).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from hw.block import LARGEST

RECORD_BYTES = 512
RECORD_POWER = 9  # 2**9 bytes
FRAME_WORDS = 16
MOST_SAMPLES = 4096  # 512 bytes hold at most 28 words of 7 samples for each of 7 frames
TIME_CORRECTED = 0x02  # activity flag: the time correction is in the start time already
MOST_BLOCKETTES = 8
ENCODINGS = {1: "i2", 3: "i4", 4: "f4", 5: "f8"}
STEIM_1, STEIM_2 = 10, 11
# Steim 2, by the two bits of the word in its frame's control word and the two highest bits of the word: how many
# differences of how many bits. Steim 1 has only whole bytes.
STEIM_2_WORDS = {(2, 1): (1, 30), (2, 2): (2, 15), (2, 3): (3, 10), (3, 0): (5, 6), (3, 1): (6, 5), (3, 2): (7, 4)}
STEIM_1_WORDS = {2: (2, 16), 3: (1, 32)}


class RecordError(Exception):
    """Bytes that are no record, or one that this program cannot read."""


@dataclass(frozen=True, slots=True, eq=False)
class MiniseedRecord:
    """Samples (n,) of one channel, NETWORK.STATION.LOCATION.CHANNEL; `start_ns` is UTC of the first one."""

    channel: str
    start_ns: int
    rate_hz: float
    samples: NDArray[np.int32] | NDArray[np.float64]


def decode(data: bytes) -> MiniseedRecord:
    """Decode one record of RECORD_BYTES. Raises RecordError, and nothing else, whatever the bytes are."""
    if len(data) != RECORD_BYTES:
        raise RecordError(f"{len(data)} bytes, not {RECORD_BYTES}")
    names, order = _text(data), _byte_order(data)
    year, day, hour, minute, second, fraction, count = struct.unpack(order + "HHBBBxHH", data[20:32])
    factor, multiplier, activity, blockettes = struct.unpack(order + "hhBxxB", data[32:40])
    correction, begin, at = struct.unpack(order + "iHH", data[40:48])
    encoding, big, microseconds = _blockettes(data, order, at, blockettes)
    if not 48 <= begin < RECORD_BYTES or not 0 < count <= MOST_SAMPLES:
        raise RecordError(f"{count} samples from byte {begin} on")
    try:
        start = datetime(year, 1, 1, hour, minute, tzinfo=UTC) + timedelta(days=day - 1, seconds=second)
        start_ns = round(start.timestamp()) * 10**9
    except (ValueError, OverflowError) as error:
        raise RecordError(f"start time: {error}") from None
    late = 0 if activity & TIME_CORRECTED else correction
    start_ns += (fraction + late) * 100_000 + microseconds * 1000
    samples = _samples(data[begin:], encoding, ">" if big else "<", count)
    return MiniseedRecord(names, start_ns, _rate_hz(factor, multiplier), samples)


def _text(data: bytes) -> str:
    """The names of the channel, as NETWORK.STATION.LOCATION.CHANNEL."""
    try:
        station, location, channel, network = (
            data[begin:stop].decode("ascii").strip() for begin, stop in ((8, 13), (13, 15), (15, 18), (18, 20))
        )
    except UnicodeDecodeError:
        raise RecordError("names that are not ASCII") from None
    return f"{network}.{station}.{location}.{channel}"


def _byte_order(data: bytes) -> str:
    """The order of the header's numbers; the year tells it (SEED manual: a year from 1900 to 2100)."""
    for order in "><":
        if 1900 <= struct.unpack(order + "H", data[20:22])[0] <= 2100:
            return order
    raise RecordError("no year between 1900 and 2100")


def _blockettes(data: bytes, order: str, at: int, most: int) -> tuple[int, bool, int]:
    """Encoding, whether the samples are big-endian, and microseconds of the start time."""
    found: tuple[int, bool] | None = None
    microseconds = 0
    for _ in range(min(most, MOST_BLOCKETTES)):
        if not 48 <= at <= RECORD_BYTES - 8:
            break
        kind, following = struct.unpack(order + "HH", data[at : at + 4])
        if kind == 1000:
            found = data[at + 4], data[at + 5] == 1
            if data[at + 6] != RECORD_POWER:
                raise RecordError(f"a record of 2**{data[at + 6]} bytes, not {RECORD_BYTES}")
        elif kind == 1001:
            microseconds = int.from_bytes(data[at + 5 : at + 6], "big", signed=True)
        if following <= at:
            break
        at = following
    if found is None:
        raise RecordError("no blockette 1000, which states the encoding")
    return *found, microseconds


def _rate_hz(factor: int, multiplier: int) -> float:
    """Samples per second, or, where a number is negative, seconds per sample."""
    if factor == 0 or multiplier == 0:
        raise RecordError("a sampling rate of zero")
    rate = float(factor) if factor > 0 else -1.0 / factor
    return rate * multiplier if multiplier > 0 else -rate / multiplier


def _samples(data: bytes, encoding: int, order: str, count: int) -> NDArray[np.int32] | NDArray[np.float64]:
    if encoding in (STEIM_1, STEIM_2):
        return _steim(data, encoding, order, count)
    if encoding not in ENCODINGS:
        raise RecordError(f"encoding {encoding}; known are {', '.join(map(str, (*ENCODINGS, STEIM_1, STEIM_2)))}")
    kind = np.dtype(order + ENCODINGS[encoding])
    if count * kind.itemsize > len(data):
        raise RecordError(f"{count} samples of {kind.itemsize} bytes in {len(data)} bytes")
    values = np.frombuffer(data, kind, count)
    if kind.kind == "i":
        return values.astype(np.int32)
    with np.errstate(invalid="ignore"):
        decimals = values.astype(np.float64)
    if not (np.abs(decimals) <= LARGEST).all():
        raise RecordError("a sample that is not a finite number, or too large")
    return decimals


def _steim(data: bytes, encoding: int, order: str, count: int) -> NDArray[np.int32]:
    """First sample and differences; the last sample is stated too and must come out."""
    words = np.frombuffer(data[: len(data) // 64 * 64], order + "u4").astype(np.uint32).reshape(-1, FRAME_WORDS)
    if not len(words):
        raise RecordError("no frame of differences")
    first, last = words[0, 1:3].astype(np.int64)
    differences: list[int] = []
    for row in words.tolist():
        control = row[0]
        for k in range(1, FRAME_WORDS):
            differences += _differences(row[k], control >> 2 * (FRAME_WORDS - 1 - k) & 3, encoding, order)
        if len(differences) >= count:
            break
    if len(differences) < count:
        raise RecordError(f"{count} samples, but only {len(differences)} differences")
    steps = np.array(differences[:count], np.int64)
    steps[0] = first
    values = np.cumsum(steps).astype(np.uint32)
    if values[-1] != last:
        raise RecordError("the differences do not lead to the last sample")
    return values.view(np.int32)


def _differences(word: int, control: int, encoding: int, order: str) -> list[int]:
    """The differences in one word of a frame; `control` are its two bits of the control word.

    Differences of whole bytes stand in the order of the bytes, so in a little-endian word the last one comes first.
    """
    if control == 0:
        return []
    if control == 1:
        n, bits = 4, 8
    elif encoding == STEIM_1:
        n, bits = STEIM_1_WORDS[control]
    elif (control, word >> 30) in STEIM_2_WORDS:
        n, bits = STEIM_2_WORDS[control, word >> 30]
    else:
        raise RecordError("a word of differences with an unknown width")
    half, mask = 1 << bits - 1, (1 << bits) - 1
    found = [((word >> bits * (n - 1 - i) & mask) ^ half) - half for i in range(n)]
    return found[::-1] if order == "<" and bits in (8, 16) else found
