"""The dialogue of a bench: what a person's answers do. Sessions with sensors are in `test_guided_bench.py`."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from agent.bench.dialogue import Dialogue, StopStay

STOPS = [SimpleNamespace(name=name) for name in ("35 0", "35 120")]


def chosen(*answers: str | None) -> tuple[str | None, list[str]]:
    """The name of the stop that a person takes who gives these answers, None for the end; and what was said."""
    given, said = iter(answers), list[str]()
    by_name = {stop.name: stop for stop in STOPS}
    session = SimpleNamespace(stops=STOPS, stop_named=by_name.get)
    mind: Any = SimpleNamespace(session=session, next_stop=lambda: (SimpleNamespace(stop=0), None))
    screen: Any = SimpleNamespace(say=said.append, warn=said.append, turn=lambda *_: None, ask=lambda _: next(given))
    capture: Any = SimpleNamespace(messages=list)
    stop = Dialogue(mind, capture, StopStay(), screen)._next_stop()
    assert list(given) == [], "each answer was asked for"
    return stop.name if stop else None, said


@pytest.mark.parametrize("end", [None, "q"])
def test_q_and_the_end_of_input_end_the_session(end: str | None) -> None:
    assert chosen(end) == (None, [])
    assert chosen("u", end) == (None, ["  no stop was taken yet"])


def test_a_stop_is_the_suggested_or_the_typed_one() -> None:
    assert chosen("") == ("35 0", [])
    assert chosen("35 120") == ("35 120", [])
    assert chosen("somewhere", "") == ("35 0", ["  'somewhere' is no position; type it as '35 0'"])
