"""MicroStrain's MIP protocol: packets, fields and commands; pure functions, no port.

Source: MicroStrain's mip_sdk (mip_packet.c, mip_field.c and mip_cmdqueue.c: packets, fields, replies; definitions/
commands_base.h, commands_3dm.h, data_sensor.h and data_shared.h: commands and data; examples/c: the order of commands).

Generations differ: devices up to 3DM-GX5, CV5 and CX5 have commands for the IMU alone (message format 0x08, base rate
0x06, low-pass filter 0x50) and number their streams from 1; CV7, GV7 and GQ7 have commands that name the set of data
(0x0F, 0x0E, 0x54). Which a device has, it tells itself.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.frames import CHECKSUMS, Found

SYNC = b"\x75\x65"
HEADER, CHECKSUM, LEAST_FIELD = 4, 2, 2  # bytes
BASE, SENSOR_COMMANDS, SENSOR_DATA = 0x01, 0x0C, 0x80  # sets of descriptors; from 0x80 on of data
IDLE, DEVICE_INFO, DESCRIPTORS, RESUME, MORE_DESCRIPTORS = 0x02, 0x03, 0x04, 0x06, 0x07
IMU_BASE_RATE, IMU_FORMAT, BASE_RATE, FORMAT, STREAM = 0x06, 0x08, 0x0E, 0x0F, 0x11
TO_VEHICLE, ACCELERATION_BIAS, IMU_LOW_PASS, RANGE, RANGES, LOW_PASS = 0x31, 0x37, 0x50, 0x52, 0x53, 0x54
ACKNOWLEDGED = 0xF1
REPLIES = {  # field with the answer to a command
    (BASE, DEVICE_INFO): 0x81, (BASE, DESCRIPTORS): 0x82, (BASE, MORE_DESCRIPTORS): 0x86,
    (SENSOR_COMMANDS, IMU_BASE_RATE): 0x83, (SENSOR_COMMANDS, IMU_FORMAT): 0x80, (SENSOR_COMMANDS, BASE_RATE): 0x8E,
    (SENSOR_COMMANDS, FORMAT): 0x8F, (SENSOR_COMMANDS, IMU_LOW_PASS): 0x8B, (SENSOR_COMMANDS, LOW_PASS): 0xD4,
    (SENSOR_COMMANDS, RANGE): 0xD2, (SENSOR_COMMANDS, RANGES): 0xD3,
}  # fmt: skip
REFUSALS = {1: "does not know it", 2: "got a wrong checksum", 3: "does not take its value", 4: "failed", 5: "timed out"}
WRITE, READ = 0x01, 0x02
ACCELERATION, GPS_TIME, REFERENCE_TIME = 0x04, 0x12, 0xD5  # of SENSOR_DATA
FIELD_BYTES = {ACCELERATION: 14, GPS_TIME: 14, REFERENCE_TIME: 10}
ACCELEROMETER = 1  # in commands of ranges
WEEK_S = 604_800.0


@dataclass(frozen=True, slots=True)
class Generation:
    """The commands that differ. `which` names the set of data where a command wants it, `frequency_bytes` follow the
    two switches of the low-pass filter."""

    base_rate: int
    format: int
    low_pass: int
    which: bytes
    frequency_bytes: int

    def stream(self, data_set: int) -> int | None:
        """The number of a stream in the command that turns it on; None where the device has no such stream."""
        return data_set if self.which else {0x80: 1, 0x81: 2, 0x82: 3}.get(data_set)

    def filter_line(self, corner_hz: float) -> str:
        """The low-pass filter as a known filter: of one pole up to GX5; of the later ones the order is not told."""
        return f"lowpass corner_hz={corner_hz:g}" + (" u_corner_pct=50" if self.which else "")


UP_TO_GX5 = Generation(IMU_BASE_RATE, IMU_FORMAT, IMU_LOW_PASS, b"", 3)
FROM_CV7_ON = Generation(BASE_RATE, FORMAT, LOW_PASS, bytes([SENSOR_DATA]), 4)


def generation(known: set[tuple[int, int]]) -> Generation:
    """The generation of a device that knows these descriptors."""
    return FROM_CV7_ON if (SENSOR_COMMANDS, FORMAT) in known else UP_TO_GX5


def packet(descriptor_set: int, *fields: tuple[int, bytes]) -> bytes:
    """A packet with these fields, each descriptor and data."""
    payload = b"".join(bytes([len(data) + LEAST_FIELD, descriptor]) + data for descriptor, data in fields)
    body = SYNC + bytes([descriptor_set, len(payload)]) + payload
    return body + _checksum(body)


def fields(whole: bytes) -> Iterator[tuple[int, bytes]]:
    """Descriptor and data of each field of a packet."""
    at, end = HEADER, len(whole) - CHECKSUM
    while at < end:
        yield whole[at + 1], whole[at + LEAST_FIELD : at + whole[at]]
        at += whole[at]


def find(data: bytes) -> Found:
    """Find all packets in `data`: with the right checksum, and filled by their fields."""
    starts: list[int] = []
    ends: list[int] = []
    at = free = 0
    while (at := data.find(SYNC, at)) >= 0 and at + HEADER <= len(data):
        end = at + HEADER + data[at + 3] + CHECKSUM
        if end > len(data):
            break
        if data[end - CHECKSUM : end] == _checksum(data[at : end - CHECKSUM]) and _is_filled(data[at:end]):
            starts.append(at)
            ends.append(end)
            at = free = end
        else:
            at += 1
    rest_at = at if at >= 0 else len(data) - data[free:].endswith(SYNC[:1])
    return Found(data, np.array(starts, np.int64), np.array(ends, np.int64), rest_at)


def _checksum(body: bytes) -> bytes:
    return CHECKSUMS["fletcher16"][1](body, "little").to_bytes(CHECKSUM, "little")


def _is_filled(whole: bytes) -> bool:
    at, end = HEADER, len(whole) - CHECKSUM
    while at < end and whole[at] >= LEAST_FIELD:
        at += whole[at]
    return at == end


def packets(found: Found) -> list[bytes]:
    """The packets that were found."""
    return [found.data[begin:end] for begin, end in zip(found.start.tolist(), found.end.tolist(), strict=True)]


def samples(whole: list[bytes], clock: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Accelerations (n, 3) in g, times (n,) in s by the field `clock`, and which packets (n,) have both."""
    rows, times, which = [], [], []
    for i, one in enumerate(whole):
        held = dict(fields(one)) if one[2] == SENSOR_DATA else {}
        sizes = [len(held.get(descriptor, b"")) + LEAST_FIELD for descriptor in (ACCELERATION, clock)]
        if sizes == [FIELD_BYTES[ACCELERATION], FIELD_BYTES[clock]]:
            rows.append(struct.unpack(">3f", held[ACCELERATION]))
            times.append(time_s(held[clock], clock))
            which.append(i)
    return np.array(rows, np.float64).reshape(-1, 3), np.array(times, np.float64), np.array(which, np.int64)


def time_s(data: bytes, clock: int) -> float:
    """Time in s of a time field: since the start of the device, or of the GPS week."""
    if clock == REFERENCE_TIME:
        return int.from_bytes(data, "big") * 1e-9
    (within_week_s, _, _) = struct.unpack(">dHH", data)
    return float(within_week_s)


def answer(heard: bytes, descriptor_set: int, command: int) -> tuple[int, bytes] | None:
    """What a device answers to a command: code (0 is yes) and the data behind it; None where there is no answer yet."""
    for one in packets(find(heard)):
        if one[2] != descriptor_set:
            continue
        held = list(fields(one))
        for i, (descriptor, data) in enumerate(held):
            if descriptor == ACKNOWLEDGED and len(data) == 2 and data[0] == command:
                reply, after = REPLIES.get((descriptor_set, command)), held[i + 1 : i + 2]
                return data[1], after[0][1] if after and after[0][0] == reply else b""
    return None


def text(data: bytes) -> str:
    """A text of 16 characters, without the blanks around it."""
    return data.decode("ascii", "replace").strip(" \0")


def descriptors(data: bytes) -> set[tuple[int, int]]:
    """Pairs of set and descriptor."""
    return set(zip(data[::2], data[1::2], strict=False))


def ranges_g(data: bytes) -> dict[int, float]:
    """Setting -> range in g, of the answer to RANGES: kind of sensor, number, and pairs."""
    return {data[at]: struct.unpack(">f", data[at + 1 : at + 5])[0] for at in range(2, len(data) - 4, 5)}
