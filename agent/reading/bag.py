"""What every bag of ROS gives, whatever file it is in: channels with their types, and messages as bytes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from agent.reading.source import TableError

MOST_DEFINITION = 1 << 20  # bytes of the definition of a type; the longest of ROS have some 20 kB
MOST_CHANNELS = 1 << 13
# How messages are serialized, by the language of their definition; others are not read.
SERIALS = {"ros2msg": "cdr", "ros1msg": "ros1"}


@dataclass(frozen=True, slots=True)
class BagChannel:
    """What one publisher sent: its topic, the type of the messages, and how they are defined and serialized.

    `language`: of the definition, a key of SERIALS where it can be read.
    """

    topic: str
    kind: str
    language: str
    definition: str
    serial: str

    @property
    def is_read(self) -> bool:
        """Whether the numbers of its messages can be read."""
        return bool(self.kind) and SERIALS.get(self.language or "ros2msg") == (self.serial or "cdr")

    def __str__(self) -> str:
        if self.is_read:
            return f"{self.topic} ({self.kind})"
        how = self.serial if self.language in SERIALS else self.language
        return f"{self.topic} ({self.kind or 'no type'}, {how or 'no definition'})"


@dataclass(frozen=True, slots=True)
class BagMessage:
    """One message: its channel, when it was recorded and published, in ns since 1970, and its bytes."""

    channel: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class Bag(ABC):
    """A file with messages. `channels`: found so far by a pass over the messages.

    `said`: what the user should know of the last pass: that the file is cut, and where.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, BagChannel] = {}
        self.said: list[str] = []

    @abstractmethod
    def messages(self) -> Iterator[BagMessage]:
        """Yield the messages as they stand in the file. A file that was cut is read up to the cut. Raises TableError.

        The channel of each message is in `channels`; messages of a channel that is not declared are counted in `said`.
        """

    def declare(self, number: int, channel: BagChannel) -> None:
        """Add a channel. Raises TableError where there are more than any bag has."""
        if len(self.channels) >= MOST_CHANNELS and number not in self.channels:
            raise TableError(f"{self.path}: the file has more than {MOST_CHANNELS} channels; record fewer topics")
        self.channels[number] = channel

    def cut(self, at: int, size: int, reason: str) -> None:
        """Say that the file was cut."""
        self.said.append(
            f"{self.path}: the file ends early, as after a power cut; it is read up to byte {at} of {size} ({reason})"
        )

    def undeclared(self, count: int) -> None:
        """Say that messages are left out since nothing tells what they are."""
        if count:
            self.said.append(f"{self.path}: {count} messages are left out, since no record declares their channel")
