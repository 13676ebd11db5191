"""Reading refuses files whose order, numbers or topics contradict each other, though every sum in them is right."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from agent.recording.messages import encode, topic_of
from agent.recording.reading import RecordingReader, first_event
from tests.replay.forgery import write_messages
from tests.replay.stand_in import CONFIG, StandIn, happenings, run_start

Messages = list[tuple[str, int, bytes]]


def sound() -> Messages:
    """A RunStart with its result, and some events."""
    pipeline = StandIn(CONFIG)
    messages = []
    for number, event in enumerate([run_start(pipeline, 0, 1), *happenings(4, seed=1)]):
        messages += [(topic_of(item), number, encode(number, item)) for item in (event, *pipeline.step(event))]
    return messages


def read(tmp_path: Path, messages: Messages) -> tuple[int, str]:
    """(events read, fault)."""
    path = tmp_path / "x.mcap"
    write_messages(path, messages)
    reader = RecordingReader(path)
    count = len(list(reader.steps()))
    return count, str(reader.fault or "")


def swap(messages: Messages) -> Messages:
    return [*messages[:3], messages[4], messages[3], *messages[5:]]


def other_topic(messages: Messages) -> Messages:
    at = next(i for i, message in enumerate(messages) if message[0] == "/acc/raw")
    return [*messages[:at], ("/other/raw", *messages[at][1:]), *messages[at + 1 :]]


def other_sequence(messages: Messages) -> Messages:
    topic, _, data = messages[-1]
    return [*messages[:-1], (topic, 999, data)]


def late_result(messages: Messages) -> Messages:
    return [messages[0], *messages[2:4], messages[1], *messages[4:]]


@pytest.mark.parametrize(
    ("alter", "reason"),
    [
        (lambda messages: messages[1:], "a result of event 0 does not follow that event"),
        (lambda messages: messages[2:], "does not begin with a RunStart"),
        (lambda messages: [messages[0], *messages], "has a second RunStart"),
        (lambda messages: messages[:4] + messages[5:], "follows event"),
        (swap, "follows event"),
        (late_result, "a result of event 0 does not follow that event"),
        (other_topic, "the message says topic /acc/raw"),
        (other_sequence, "the message says"),
    ],
)
def test_contradictions_are_refused(tmp_path: Path, alter: Callable[[Messages], Messages], reason: str) -> None:
    messages = sound()
    whole, fault = read(tmp_path, messages)
    assert fault == ""
    count, fault = read(tmp_path, alter(messages))
    assert reason in fault
    assert count < whole


def test_first_event_is_none_where_there_is_no_recording(tmp_path: Path) -> None:
    write_messages(tmp_path / "x.mcap", sound())
    start = first_event(tmp_path / "x.mcap")
    assert start is not None
    assert start.run_id == "run-1"
    (tmp_path / "y.mcap").write_bytes(b"no")
    assert first_event(tmp_path / "y.mcap") is None
    assert first_event(tmp_path / "gone.mcap") is None
    assert first_event(tmp_path) is None
