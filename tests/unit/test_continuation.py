"""A run begins with the states that the recordings before it left."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import pytest

from agent.core.memory import MOST_MEMORIES, Memory
from agent.delivery.store import Store
from agent.recording.continuation import continues, states_left
from tests.attacks.store_site import Run, rests, states

A, B, OTHER = Memory("s", "A", 5, b"a"), Memory("s", "B", 5, b"b"), Memory("other", "A", 5, b"o")


@pytest.mark.parametrize(
    ("before", "kept", "fault"),
    [
        ([], [], ""),
        ([A, B], [B, A], ""),
        ([A], [Memory("s", "A", 1_000_005, b"a")], ""),
        ([A], [Memory("s", "A", 5, b"x")], "the state of 's' ('A') is not the one"),
        ([A, B], [A], "the state of 's' ('B') is missing"),
        ([A], [], "the state of 's' ('A') is missing"),
        ([A], [A, B], "it begins with a state of 's' ('B') that the recordings before it did not leave"),
        ([A, OTHER], [A], ""),
    ],
)
def test_states_must_be_the_same_of_every_device_of_a_configured_sensor(
    before: list[Memory], kept: list[Memory], fault: str
) -> None:
    said = continues(before, kept, ["s"])
    assert fault in said
    assert bool(fault) == bool(said)


def test_the_states_of_a_sensor_wait_until_it_is_configured_again() -> None:
    known = states_left([], [A, OTHER], ["s", "other"])
    known = states_left(known, [B], ["s"])
    assert known == [OTHER, B]
    assert continues(known, [B, OTHER], ["s", "other"]) == ""
    assert states_left(known, [], ["s"]) == [OTHER], "a configured sensor of which nothing is known has no state"


def test_the_store_keeps_the_states_of_a_sensor_that_is_not_configured(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    store.commit([], [A, OTHER])
    store.end(["s"], [B])
    store.close()
    again = Store(tmp_path, 0)
    assert states(again.states) == states([B, OTHER])
    again.close()


@pytest.mark.slow
@pytest.mark.parametrize("end", ["stop", "kill"])
def test_of_more_devices_than_are_kept_recording_and_store_keep_the_same(tmp_path: Path, end: str) -> None:
    run = Run(tmp_path)
    for number in range(MOST_MEMORIES + 2):
        run.feed(islice(rests(number, f"N{number}", 10.0 * number), 14))
    assert len(run.pipeline.all_memories()) == MOST_MEMORIES
    getattr(run, end)()
    again = Run(tmp_path, 2)
    assert (again.faults, continues(run.pipeline.all_memories(), again.begun_with, ["s"])) == ([], "")
    assert list(states(again.begun_with)) == list(states(run.pipeline.all_memories())), "in their order"
    again.kill()


def test_results_that_no_recording_has_leave_states_that_no_recording_has(tmp_path: Path) -> None:
    """The disk was full at the end of a run: the next one goes on with what the store has, and numbers tell of it."""
    run = Run(tmp_path).feed(islice(rests(), 42))
    recorded = run.pipeline.all_memories()
    run.recorder.close()
    run.feed(islice(rests(), 42, None))
    run.store.close()
    run.alive = False
    again = Run(tmp_path, 2)
    assert again.faults == []
    assert "is not the one that the recordings before it left" in continues(recorded, again.begun_with, ["s"])
    assert again.begun_with[0].sequence > recorded[0].sequence
    again.kill()
