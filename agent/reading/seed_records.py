"""The records of a MiniSEED file (version 2): where each begins, its channel, its time and its number of samples.

The layout is that of the SEED manual (FDSN, version 2.4): fixed section of the data header, blockettes 1000 and 1001.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

_BEGIN = re.compile(rb"\d{6}[DRQM][ \x00]")
_HEADER = "5s2s3s2sHHBBBBHHhhBBBBiHH"  # from the station's code on, at byte 8
_HEADERS = {order: struct.Struct(order + _HEADER) for order in "<>"}
_BLOCKETTES = {order: struct.Struct(order + "HH") for order in "<>"}
HEADER_BYTES, STATION_AT = 48, 8
SHORTEST, LONGEST = 7, 20  # powers of 2: bytes of a record
YEARS = range(1900, 2200)
CORRECTED = 2  # activity flag: the time correction is in the time already
MOST_BLOCKETTES = 64
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class SeedRecord:
    """A record: `at` and `length` in bytes; `seed_id`: network.station.location.channel; `start_ns` since 1970."""

    at: int
    length: int
    seed_id: str
    start_ns: int
    samples: int


def records(data: bytes) -> Iterator[SeedRecord]:
    """Yield the records that begin with a header. What is between them is passed over.

    The last one reaches beyond the end of `data` where the file is cut.
    """
    at = 0
    while found := _BEGIN.search(data, at):
        record = _record(data, found.start())
        if record is None:
            at = found.start() + 1
            continue
        yield record
        at = record.at + record.length


def _record(data: bytes, at: int) -> SeedRecord | None:
    """The record at byte `at`; None where none is."""
    header = data[at + STATION_AT : at + HEADER_BYTES]
    if len(header) < HEADER_BYTES - STATION_AT:
        return None
    order = ">" if struct.unpack_from(">H", header, 12)[0] in YEARS else "<"
    told = _HEADERS[order].unpack(header)
    codes, (year, day, hour, minute, second, _, fraction), samples = told[:4], told[4:11], told[11]
    activity, correction, first_blockette = told[14], told[18], told[20]
    if year not in YEARS or not 1 <= day <= 366 or hour > 23 or minute > 59 or second > 60 or fraction > 9999:
        return None
    power, microseconds = _blockettes(data, at, first_blockette, order)
    length = 1 << power if power else _to_next(data, at)
    station, location, channel, network = (code.decode("ascii", "replace").strip(" \0") for code in codes)
    start = datetime(year, 1, 1, hour, minute, tzinfo=UTC) + timedelta(days=day - 1) - EPOCH
    late = 0 if activity & CORRECTED else correction
    start_ns = (start // timedelta(seconds=1) + second) * 10**9 + (fraction + late) * 100_000 + microseconds * 1000
    return SeedRecord(at, length, f"{network}.{station}.{location}.{channel}", start_ns, samples)


def _blockettes(data: bytes, at: int, first: int, order: str) -> tuple[int, int]:
    """The power of 2 of the record's length, 0 where it is not told, and the microseconds of its time."""
    power = microseconds = 0
    here = first
    for _ in range(MOST_BLOCKETTES):
        if here < HEADER_BYTES or at + here + 8 > len(data):
            break
        kind, following = _BLOCKETTES[order].unpack_from(data, at + here)
        if kind == 1000 and SHORTEST <= data[at + here + 6] <= LONGEST:
            power = data[at + here + 6]
        elif kind == 1001:
            (microseconds,) = struct.unpack_from("b", data, at + here + 5)
        if following <= here:
            break
        here = following
    return power, microseconds


def _to_next(data: bytes, at: int) -> int:
    """The length of a record that does not tell it: up to where the next one begins, or to the end."""
    for power in range(SHORTEST, LONGEST):
        if _BEGIN.match(data, at + (1 << power)):
            return 1 << power
    return len(data) - at
