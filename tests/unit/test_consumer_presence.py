"""A consumer asks each gateway that is on the bus, so that a result of which no message comes is not lost."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
import zenoh

from agent.delivery import presence
from agent.delivery.answers import answer_queries
from agent.delivery.consumer import Consumer
from agent.delivery.holding import AT_ONCE, LOOKS_MAX, WaitingResults
from agent.delivery.keys import presence_key
from agent.delivery.presence import Presence
from agent.delivery.store import Store
from tests.unit.zenoh_site import KEY, Site, record, wait_for


@contextmanager
def silent_gateway(site: Site, store: Store) -> Iterator[None]:
    """It has a token and answers queries from its store, but all of its messages are lost."""
    with site.client() as session:
        queryable = session.declare_queryable(f"{KEY}/**", zenoh.handlers.FifoChannel(64), complete=True)
        told = (queryable, KEY, store.history, dict)
        threading.Thread(target=answer_queries, args=told, daemon=True).start()
        token = session.liveliness().declare_token(f"{KEY}/alive")
        yield
        token.undeclare()
        queryable.undeclare()


def test_results_of_which_no_message_comes_are_asked_for(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(presence, "LOOK_S", 0.5)
    store = Store(tmp_path)
    first = store.last_sequence() + 1
    store.commit([record(first)])
    with Consumer([site.endpoint]) as consumer:
        results = iter(consumer)
        with silent_gateway(site, store):
            assert next(results).sequence == first  # when the gateway appears
            store.commit([record(first + 1), record(first + 2)])
            assert [next(results).sequence for _ in range(2)] == [first + 1, first + 2]  # at the next look
        store.commit([record(first + 3)])
        with silent_gateway(site, store):
            assert next(results).sequence == first + 3
    store.close()


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("fieldcal/v1/**", "fieldcal/v1/*/*/alive"),
        ("fieldcal/v1/**/calibration", "fieldcal/v1/*/*/alive"),
        ("fieldcal/v1/s/**", "fieldcal/v1/s/*/alive"),
        ("fieldcal/v1/*/g/mems/window", "fieldcal/v1/*/g/alive"),
    ],
)
def test_the_tokens_of_the_gateways_of_a_key_expression(key: str, expected: str) -> None:
    assert presence_key(key) == expected


def test_a_gateway_is_looked_at_when_it_appears_and_then_about_once_a_minute(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    news: queue.SimpleQueue[None] = queue.SimpleQueue()
    now_s = [1000.0]
    with site.client() as session, site.client() as gateways:
        watched = Presence(session, "fieldcal/v1/site/**", lambda: news.put(None))
        monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
        token = gateways.liveliness().declare_token("fieldcal/v1/site/gw/alive")
        gateways.liveliness().declare_token("fieldcal/v1/other/gw/alive")
        news.get(timeout=60)
        assert (watched.due(0), watched.wait_s()) == ([], 0.0)  # the consumer asks enough others
        assert watched.due(5) == ["site/gw"]
        looks = []
        for _ in range(1000):
            now_s[0] += 1.0
            looks += [now_s[0]] * len(watched.due(5))
        apart = [b - a for a, b in pairwise(looks)]
        assert 30.0 <= min(apart) <= max(apart) <= 91.0
        assert 9 <= len(looks) <= 33
        token.undeclare()
        news.get(timeout=60)
        now_s[0] += 100.0
        assert (watched.due(5), watched.wait_s()) == ([], None)
        watched.close()


def test_tokens_of_gateways_that_do_not_exist_take_bounded_memory(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presence, "GATEWAYS_MAX", 10)
    with site.client() as session, site.client() as stranger:
        watched = Presence(session, "fieldcal/v1/**", lambda: None)
        found: list[str] = []
        for _ in range(5):  # each time they come anew
            tokens = [stranger.liveliness().declare_token(f"fieldcal/v1/s/gw{k}/alive") for k in range(30)]
            wait_for(lambda: bool(found.extend(watched.due(100)) or found))  # type: ignore[func-returns-value]
            for token in tokens:
                token.undeclare()
        assert len(watched._look_s) <= 10
        assert len(watched._looks) <= 21
        watched.close()


def test_gateways_that_are_looked_at_take_no_place_of_those_whose_results_wait() -> None:
    held = WaitingResults()
    for k in range(LOOKS_MAX):
        assert held.room() == LOOKS_MAX - k
        held.look(f"site/gw{k}", known=True)
    held.look("site/gw0", known=True)
    assert held.room() == 0
    asked = held.due()
    assert len(asked) == AT_ONCE
    assert held.room() == AT_ONCE
    for source in asked:
        assert not held.asked(source, answered=False, known=True)
        held.ended(source)
    assert held.due() == [f"site/gw{k}" for k in range(AT_ONCE, LOOKS_MAX)]
