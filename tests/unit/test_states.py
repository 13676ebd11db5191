"""The states of sensors from the store and from recordings: which of them counts, and what they follow."""

from __future__ import annotations

from agent.delivery.states import States


def test_a_recording_without_a_state_follows_no_result() -> None:
    states = States()
    states.take([], 3)
    assert (states.sequence, states.memories) == (0, [])
