"""Recordings of ROS: topics of sensor_msgs Imu, and any numbers of any topics by a mapping."""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import zstandard

from agent.config.files import open_file
from agent.reading.bag import Bag, BagChannel, BagMessage
from agent.reading.bag_mcap import McapBag
from agent.reading.bag_ros1 import Ros1Bag
from agent.reading.bag_sqlite import SqliteBag
from agent.reading.in_order import PublisherStream
from agent.reading.mapping import TIMES, Topic
from agent.reading.ros2_fields import BIG, FieldError, Fields, plain, read_definition
from agent.reading.source import ROWS_AT_ONCE, Array, Column, Progress, Source, TableError

IMU = "sensor_msgs/Imu"
BAGS: dict[bytes, type[Bag]] = {b"#ROSBAG": Ros1Bag, b"SQLite ": SqliteBag}  # by their first bytes; others are MCAP
ZSTD_BEGINS, LONGEST_MESSAGE = b"\x28\xb5\x2f\xfd", 1 << 27  # `ros2 bag record --compression-mode message`
# A header is a time of 8 bytes, after four bytes of CDR, or of `seq` of ROS 1, and the frame.
_HEADER_FIRST = re.compile(r"(?:\s*(?:#.*|\w+\s+\w+\s*=.*)?\n)*\s*(?:std_msgs/(?:msg/)?)?Header\s")
FRAME_AT, LONGEST_FRAME, MOST_FRAMES, FEWEST_MESSAGES = 12, 64, 4, 10
Sender = tuple[int, bytes | None]  # a channel, and the frame where a channel has several
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
    """A recording of ROS. Each topic is a group with `time_s` and the columns that the mapping names.

    Without a mapping each topic of Imu is a group with `time_s` of the header, `x`, `y`, `z` in m/s2. A topic with
    several publishers has a group for each: TOPIC#1, TOPIC#2. Messages come in the order of their times, each once.
    Raises TableError.
    """

    header = "topics"

    def __init__(self, path: Path, mapping: Mapping[str, Topic] | None = None) -> None:
        self.path = path
        self._bag = _bag_of(path)
        counts = self._counted()
        self._senders = self._named(counts)
        self._topics = self._imus() if mapping is None else self._mapped(mapping)
        self._about = list(self._several(counts))
        self.said = [*self._bag.said, *self._about]
        self._fields = {name: self._readable(name, fields) for name, fields in self._topics.items()}
        self.columns = [column for name, fields in self._topics.items() for column in fields.columns(name)]

    def _counted(self) -> dict[Sender, int]:
        """How many messages each publisher sent.

        rosbag2 has one channel for all publishers of a topic; the frame of the header tells them apart. Where there are
        more frames than MOST_FRAMES, or one of them has hardly a message, they do not mean sensors: the channel is one.
        """
        counts: dict[int, Counter[bytes]] = {}
        for message in self._bag.messages():
            frames = counts.setdefault(message.channel, Counter())
            frame = _frame(self._bag.channels[message.channel], message)
            frames[frame if frame in frames or len(frames) <= MOST_FRAMES else b""] += 1
        found: dict[Sender, int] = {}
        for number, frames in sorted(counts.items()):
            if 1 < len(frames) <= MOST_FRAMES and min(frames.values()) >= FEWEST_MESSAGES:
                found |= {(number, frame): count for frame, count in sorted(frames.items())}
            else:
                found[number, None] = frames.total()
        return found

    def _named(self, counts: Mapping[Sender, int]) -> dict[str, Sender]:
        """The publishers, each by its topic, or by its topic and its number among several."""
        by_topic: dict[str, list[Sender]] = {}
        for sender in counts:
            by_topic.setdefault(self._bag.channels[sender[0]].topic, []).append(sender)
        return {
            f"{topic}#{k}" if len(senders) > 1 else topic: sender
            for topic, senders in sorted(by_topic.items()) for k, sender in enumerate(senders, 1)
        }  # fmt: skip

    def _several(self, counts: Mapping[Sender, int]) -> Iterator[str]:
        """Yield a line for each topic that is read and has several publishers."""
        by_topic: dict[str, list[str]] = {}
        for name in self._topics:
            sender = self._senders[name]
            frame = f"frame {sender[1].decode('utf-8', 'replace')!r}, " if sender[1] is not None else ""
            told = f"{name} ({frame}{counts[sender]} messages)"
            by_topic.setdefault(self._bag.channels[sender[0]].topic, []).append(told)
        for topic, lines in by_topic.items():
            if len(lines) > 1:
                told = ", ".join(lines)
                yield f"{self.path}: {topic} has {len(lines)} publishers, each is a group of its own: {told}"

    def _imus(self) -> dict[str, Topic]:
        """The Imu of each publisher that can be read. Raises TableError where there is none."""
        channels = {name: self._bag.channels[number] for name, (number, _) in self._senders.items()}
        imus = [name for name, channel in channels.items() if plain(channel.kind) == IMU]
        if found := [name for name in imus if channels[name].is_read]:
            return dict.fromkeys(found, ACCELERATION)
        if not channels:
            told = self._bag.said[-1] if self._bag.said else f"{self.path}, topics: none"
            raise TableError(f"{told}; no message is there; record it anew, or write the file anew from its source")
        if not any(channel.is_read for channel in channels.values()):
            raise TableError(
                f"{self.path}, topics: no topic can be read; the topics are {self._topics_text()}; only messages "
                "of ROS with ros2msg in CDR, or with ros1msg, are read: write the samples as CSV"
            )
        raise TableError(
            f"{self.path}, topics: no topic is {IMU} that can be read; the topics are {self._topics_text()}; state the "
            "fields of others with --mapping"
        )

    def _mapped(self, mapping: Mapping[str, Topic]) -> dict[str, Topic]:
        """The mapping of each publisher. Raises TableError where it names a topic that has no messages."""
        found: dict[str, Topic] = {}
        for topic, fields in mapping.items():
            names = [n for n, (number, _) in self._senders.items() if topic in (n, self._bag.channels[number].topic)]
            if not names:
                raise TableError(
                    f"{self.path}, topics: there is no topic {topic!r} with messages; "
                    f"the topics are {self._topics_text()}"
                )
            found |= dict.fromkeys(names, fields)
        return found

    def _topics_text(self) -> str:
        """The topics with their types, for messages."""
        numbers = dict.fromkeys(number for number, _ in self._senders.values())
        return ", ".join(str(self._bag.channels[number]) for number in numbers) or "none"

    def _readable(self, name: str, fields: Topic) -> Fields:
        channel = self._bag.channels[self._senders[name][0]]
        if not channel.is_read:
            raise TableError(
                f"{self.path}: {channel} cannot be read: only messages of ROS with ros2msg in CDR, or with ros1msg, "
                "are; write the samples as CSV"
            )
        text = channel.definition or (IMU_DEFINITION if plain(channel.kind) == IMU else "")
        if not text:
            raise TableError(
                f"{self.path}, {name}: the file has no definition of {channel.kind}, as before ROS 2 Iron; write it as "
                "MCAP with `ros2 bag convert`"
            )
        try:
            root, types = read_definition(channel.kind, text)
            paths = [path for path in fields.paths.values() if path not in TIMES]
            return Fields(root, types, paths, channel.serial)
        except FieldError as error:
            raise TableError(f"{self.path}, {name}: {error}") from None

    def pieces(self, columns: Sequence[Column], progress: Progress | None) -> Iterator[Array]:
        """Yield the samples of one publisher. Raises TableError."""
        name = columns[0].group
        if any(column.group != name for column in columns):
            raise TableError(f"{self.path}: the columns belong to several topics; add group=NAME of one topic")
        names = [column.name for column in self._topics[name].columns(name)]
        places = [names.index(column.name) for column in columns]
        stream = PublisherStream(len(names))
        for rows in self._rows(name):
            stream.append(rows)
        for rows in stream.rows():
            if len(rows):
                yield rows[:, places]
        self.said = [*self._bag.said, *self._about]
        if stream.moved:
            told = f"{stream.moved} messages do not stand in the order of their times; they are sorted"
            self.said.append(f"{self.path}, {name}: {told}")
        if stream.doubled:
            self.said.append(f"{self.path}, {name}: {stream.doubled} messages are there twice; each is taken once")
        if progress is not None:
            progress(self.path.stat().st_size)

    def _rows(self, name: str) -> Iterator[Array]:
        """Yield the messages of one publisher as they stand in the file, as rows of `PublisherStream`."""
        clock, fields, (number, frame) = self._topics[name].time, self._fields[name], self._senders[name]
        channel = self._bag.channels[number]
        rows: list[list[float]] = []
        for count, message in enumerate(each for each in self._bag.messages() if each.channel == number):
            if frame is not None and _frame(channel, message) != frame:
                continue
            try:
                row = fields.read(_unpacked(message))
            except FieldError as error:
                raise TableError(f"{self.path}, {name}, message {count}: {error}") from None
            if clock in TIMES:
                row.insert(0, 1e-9 * (message.log_time_ns if clock == "log_time" else message.publish_time_ns))
            rows.append([*row, message.log_time_ns, zlib.crc32(message.data)])
            if len(rows) == ROWS_AT_ONCE:
                yield np.array(rows, np.float64)
                rows = []
        if rows:
            yield np.array(rows, np.float64)


def _bag_of(path: Path) -> Bag:
    """The bag in a file. Raises TableError."""
    try:
        with open_file(path) as file:
            begin = file.read(7)
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from None
    return BAGS.get(begin, McapBag)(path)


def _frame(channel: BagChannel, message: BagMessage) -> bytes:
    """The frame in the header with which a message begins; b"" where it begins otherwise."""
    if not channel.is_read or not (_HEADER_FIRST.match(channel.definition) or plain(channel.kind) == IMU):
        return b""
    try:
        data = _unpacked(message)
        order = ">" if channel.serial != "ros1" and data[1] == BIG else "<"
        (length,) = struct.unpack_from(f"{order}I", data, FRAME_AT)
    except (FieldError, struct.error, IndexError):
        return b""
    return data[FRAME_AT + 4 : FRAME_AT + 4 + min(length, LONGEST_FRAME)].rstrip(b"\0")


def _unpacked(message: BagMessage) -> bytes:
    """The bytes of a message, which rosbag2 can have compressed each by itself. Raises FieldError."""
    if not message.data.startswith(ZSTD_BEGINS):
        return message.data
    try:
        packed = zstandard.ZstdDecompressor(max_window_size=LONGEST_MESSAGE).stream_reader(io.BytesIO(message.data))
        return packed.read(LONGEST_MESSAGE)
    except zstandard.ZstdError as error:
        raise FieldError(f"it is compressed and cannot be unpacked: {error}") from None
