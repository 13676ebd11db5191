"""Recordings of ROS 2 (MCAP): topics of sensor_msgs/msg/Imu, and any numbers of any topics by a mapping."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from agent.reading.mapping import TIMES, Topic
from agent.reading.ros2_fields import FieldError, Fields, read_definition
from agent.reading.source import ROWS_AT_ONCE, Array, Column, Progress, Source, TableError
from agent.recording.limits import Budget
from agent.recording.records import ChunkMessage, RecordError, content, unpack, walk

IMU = "sensor_msgs/msg/Imu"
ENCODINGS = ("ros2msg", "")
# Up to the acceleration; a file may state the type alone.
IMU_DEFINITION = """std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
===
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
===
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
===
MSG: geometry_msgs/Quaternion
float64[4] xyzw
===
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
ACCELERATION = Topic(
    time="header.stamp", x="linear_acceleration.x", y="linear_acceleration.y", z="linear_acceleration.z", unit="m/s2"
)


class RosBag(Source):
    """A recording of ROS 2. Each topic is a group with `time_s` and the columns that the mapping names.

    Without a mapping each topic of Imu is a group with `time_s` of the header, `x`, `y`, `z` in m/s2.
    Raises TableError.
    """

    header = "topics"

    def __init__(self, path: Path, mapping: Mapping[str, Topic] | None = None) -> None:
        self.path = path
        schemas: dict[str, Schema | None] = {}
        for _, channel, schema in self._messages():
            schemas[channel.topic] = schema
        kinds = {topic: schema.name if schema else "no schema" for topic, schema in schemas.items()}
        if mapping is None:
            mapping = {topic: ACCELERATION for topic in sorted(kinds) if kinds[topic] == IMU}
        told = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(kinds.items())) or "none"
        if not mapping:
            raise TableError(
                f"{path}, topics: no topic is {IMU}; the topics are {told}; state the fields of others with --mapping"
            )
        self._topics = dict(mapping)
        self._fields: dict[str, Fields] = {}
        for topic, fields in mapping.items():
            if topic not in schemas:
                raise TableError(f"{path}, topics: there is no topic {topic!r} with messages; the topics are {told}")
            self._fields[topic] = self._readable(topic, schemas[topic], fields)
        self.columns = [column for topic, fields in mapping.items() for column in fields.columns(topic)]

    def _readable(self, topic: str, schema: Schema | None, fields: Topic) -> Fields:
        if schema is None or schema.encoding not in ENCODINGS:
            kind = schema.encoding if schema else "no schema"
            raise TableError(f"{self.path}, {topic}: the schema is {kind}, only ros2msg is read; write it as CSV")
        text = schema.data.decode("utf-8", "replace")
        try:
            root, types = read_definition(schema.name, text or (IMU_DEFINITION if schema.name == IMU else ""))
            return Fields(root, types, [path for path in fields.paths.values() if path not in TIMES])
        except FieldError as error:
            raise TableError(f"{self.path}, {topic}: {error}") from None

    def pieces(self, columns: Sequence[Column], progress: Progress | None) -> Iterator[Array]:
        """Yield the samples of one topic. Raises TableError."""
        topic = columns[0].group
        if any(column.group != topic for column in columns):
            raise TableError(f"{self.path}: the columns belong to several topics; add group=NAME of one topic")
        names = [column.name for column in self._topics[topic].columns(topic)]
        places = [names.index(column.name) for column in columns]
        clock, fields = self._topics[topic].time, self._fields[topic]
        rows: list[list[float]] = []
        for message, channel, _ in self._messages():
            if channel.topic != topic:
                continue
            try:
                row = fields.read(message.data)
            except FieldError as error:
                raise TableError(f"{self.path}, {topic}, message {message.sequence}: {error}") from None
            if clock in TIMES:
                row.insert(0, 1e-9 * (message.log_time if clock == "log_time" else message.publish_time))
            rows.append(row)
            if len(rows) == ROWS_AT_ONCE:
                yield np.array(rows)[:, places]
                rows = []
        if rows:
            yield np.array(rows)[:, places]
        if progress is not None:
            progress(self.path.stat().st_size)

    def _messages(self) -> Iterator[tuple[ChunkMessage, Channel, Schema | None]]:
        """Yield each message with its channel and schema."""
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
                                yield part, channel, schemas.get(channel.schema_id)
                        elif isinstance(part, Schema):
                            schemas[part.id] = part
                        else:
                            channels[part.id] = part
        except RecordError as error:
            raise TableError(f"{self.path}, {error}; write the file anew with `ros2 bag convert`") from None
