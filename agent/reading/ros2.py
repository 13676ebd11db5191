"""Recordings of ROS 2 (MCAP): topics of sensor_msgs/msg/Imu."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from agent.reading.source import ROWS_AT_ONCE, Array, Column, Progress, Source, TableError
from agent.recording.limits import Budget
from agent.recording.records import ChunkMessage, RecordError, content, unpack, walk

IMU = "sensor_msgs/msg/Imu"
_STAMP = {"little": struct.Struct("<iI"), "big": struct.Struct(">iI")}
_AXES = {"little": struct.Struct("<3d"), "big": struct.Struct(">3d")}
# Bytes from the orientation to linear_acceleration: a quaternion, a covariance, angular_velocity, a covariance.
BEFORE_ACCELERATION = 8 * (4 + 9 + 3 + 9)


class RosBag(Source):
    """A recording of ROS 2. Each topic of Imu is a group with `time_s` (of the header), `x`, `y`, `z` in m/s2.

    Raises TableError.
    """

    header = "topics"

    def __init__(self, path: Path) -> None:
        self.path = path
        topics: dict[str, str] = {}
        for _, channel, schema in self._messages():
            topics[channel.topic] = schema.name if schema else "no schema"
        imu = sorted(topic for topic, kind in topics.items() if kind == IMU)
        if not imu:
            told = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())) or "none"
            raise TableError(f"{path}, topics: no topic is {IMU}; the topics are {told}; write it as CSV")
        units = {"time_s": "s", "x": "m/s2", "y": "m/s2", "z": "m/s2"}
        self.columns = [Column(name, unit, topic) for topic in imu for name, unit in units.items()]

    def pieces(self, columns: Sequence[Column], progress: Progress | None) -> Iterator[Array]:
        """Yield the samples of one topic. Raises TableError."""
        topic = columns[0].group
        if any(column.group != topic for column in columns):
            raise TableError(f"{self.path}: the columns belong to several topics; add group=NAME of one topic")
        places = [("time_s", "x", "y", "z").index(column.name) for column in columns]
        rows: list[tuple[float, ...]] = []
        for data, channel, _ in self._messages():
            if channel.topic != topic:
                continue
            try:
                rows.append(_decoded(data))
            except (struct.error, IndexError):
                raise TableError(f"{self.path}, {topic}: a message of {len(data)} bytes is no {IMU}") from None
            if len(rows) == ROWS_AT_ONCE:
                yield np.array(rows)[:, places]
                rows = []
        if rows:
            yield np.array(rows)[:, places]
        if progress is not None:
            progress(self.path.stat().st_size)

    def _messages(self) -> Iterator[tuple[bytes, Channel, Schema | None]]:
        """Yield the content of each message with its channel and schema."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        try:
            with self.path.open("rb") as file:
                budget = Budget()
                for record in walk(file, os.fstat(file.fileno()).st_size):
                    if record.opcode != Opcode.CHUNK:
                        continue
                    for part in content(record, unpack(record, budget, crc_needed=False), budget):
                        if isinstance(part, ChunkMessage):
                            if part.channel_id in channels:
                                channel = channels[part.channel_id]
                                yield part.data, channel, schemas.get(channel.schema_id)
                        elif isinstance(part, Schema):
                            schemas[part.id] = part
                        else:
                            channels[part.id] = part
        except RecordError as error:
            raise TableError(f"{self.path}, {error}; write the file anew with `ros2 bag convert`") from None


def _decoded(data: bytes) -> tuple[float, ...]:
    """Time in s and the acceleration of an Imu in CDR, whose numbers are aligned from the fourth byte on."""
    order = "little" if data[1] & 1 else "big"
    body = data[4:]
    seconds, ns = _STAMP[order].unpack_from(body)
    frame = int.from_bytes(body[8:12], "little" if order == "little" else "big")
    numbers_at = -(-(12 + frame) // 8) * 8
    return (seconds + ns * 1e-9, *_AXES[order].unpack_from(body, numbers_at + BEFORE_ACCELERATION))
