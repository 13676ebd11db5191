"""A session that counts as connected, and that the router does not hear, is closed and opened anew."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import pytest
import zenoh

from agent.delivery import hearing
from agent.delivery.consumer import Consumer
from agent.delivery.publication import UNHEARD, Publisher
from agent.delivery.session import session_config
from agent.delivery.store import Store
from agent.monitor.database import Database
from agent.monitor.engines import Sqlite
from agent.monitor.fleet import Fleet
from agent.monitor.following import Following
from tests.unit.deaf_link import Relay
from tests.unit.zenoh_site import KEY, Site, record, taken_until, wait_for


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hearing, "ASK_S", 0.2)
    monkeypatch.setattr(hearing, "ANSWER_S", 0.5)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = Store(tmp_path, 0)
    yield store
    store.close()


def on_the_bus(client: zenoh.Session) -> bool:
    return any(reply.ok for reply in client.liveliness().get(f"{KEY}/alive"))


def test_a_gateway_that_the_router_does_not_hear_comes_back_to_the_bus(
    site: Site, store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    relay = Relay(site.endpoint, deaf=1)
    publisher = Publisher("site", "gw", [relay.endpoint], store)
    publisher.start()
    wait_for(lambda: publisher.state().connected)
    store.commit([record(1), record(2)])
    for number in (1, 2):
        publisher.publish(record(number))
    with site.client() as client, Consumer([site.endpoint], last_sequence={"site/gw": 0}) as consumer:
        assert not on_the_bus(client)
        with caplog.at_level(logging.WARNING, "agent.delivery.hearing"):
            wait_for(lambda: on_the_bus(client) or store.published() > 0)
        assert on_the_bus(client), "nothing is published before the router hears the gateway"
        assert [result.sequence for result in taken_until(consumer, lambda r: r.sequence == 2)] == [1, 2]
        wait_for(lambda: publisher.state().connected and not publisher.state().fault)
    wait_for(lambda: store.published() == 2)
    assert publisher.state().reopened == 1
    assert "has not answered for 1 s" in caplog.text
    publisher.close()
    relay.close()


def test_a_consumer_that_the_router_does_not_hear_gets_all_results_all_the_same(site: Site, store: Store) -> None:
    relay = Relay(site.endpoint, deaf=1)
    publisher = Publisher("site", "gw", [site.endpoint], store)
    publisher.start()
    with Consumer([relay.endpoint], last_sequence={"site/gw": 0}) as consumer:
        store.commit([record(1), record(2)])
        for number in (1, 2):
            publisher.publish(record(number))
        wait_for(lambda: store.published() == 2)
        assert [result.sequence for result in taken_until(consumer, lambda r: r.sequence == 2)] == [1, 2]
    assert len(relay.accepted_s) == 2
    publisher.close()
    relay.close()


@pytest.mark.slow
def test_a_monitor_says_that_its_router_is_gone_until_it_is_back(site: Site, store: Store, tmp_path: Path) -> None:
    publisher, fleet = Publisher("site", "gw", [site.endpoint], store), Fleet()
    publisher.start()
    with closing(Database(Sqlite(tmp_path / "monitor.sqlite"))) as database:
        following = Following([site.endpoint], None, database, fleet)
        wait_for(lambda: [gateway["alive"] for gateway in fleet.gateways({})] == [True])
        site.kill()
        wait_for(lambda: following.state()["fault"] == f"no Zenoh router answers at {site.endpoint}")
        site.restart()
        wait_for(lambda: following.state()["fault"] == "")
        assert following.close(30.0)
    publisher.close()


@pytest.mark.slow
@pytest.mark.parametrize("deaf", [1, 2], ids=["the session for results", "both sessions"])
def test_a_monitor_that_the_router_does_not_hear_shows_the_gateway_and_its_results(
    site: Site, store: Store, tmp_path: Path, deaf: int
) -> None:
    relay = Relay(site.endpoint, deaf)
    publisher = Publisher("site", "gw", [site.endpoint], store)
    publisher.start()
    fleet = Fleet()
    with closing(Database(Sqlite(tmp_path / "monitor.sqlite"))) as database:
        following = Following([relay.endpoint], None, database, fleet)
        store.commit([record(1)])
        publisher.publish(record(1))
        wait_for(lambda: [gateway["alive"] for gateway in fleet.gateways({})] == [True])
        wait_for(lambda: "site/gw" in "".join(database.last_sequence()))
        following.close()
    publisher.close()
    relay.close()


def test_a_router_that_never_answers_gets_new_sessions_ever_less_often(
    site: Site, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hearing, "ASK_S", 0.1)
    monkeypatch.setattr(hearing, "ANSWER_S", 0.1)
    relay = Relay(site.endpoint, deaf=100)
    publisher = Publisher("site", "gw", [relay.endpoint], store, poll_s=0.02)
    publisher.start()
    wait_for(lambda: len(relay.accepted_s) == 6)
    assert publisher.state().fault == UNHEARD
    publisher.close()
    relay.close()
    apart_s = [b - a for a, b in pairwise(relay.accepted_s)]
    assert all(s >= 0.5 * 0.1 * 2**k + 2 * 0.1 for k, s in enumerate(apart_s))


def test_a_router_answers_whatever_its_access_rules() -> None:
    config = session_config("router", listen=["tcp/127.0.0.1:0"])
    only = {"id": "own", "flows": ["ingress"], "permission": "allow", "messages": ["put", "liveliness_token"],
            "key_exprs": [f"{KEY}/**"]}  # fmt: skip
    config.insert_json5("access_control", json.dumps({
        "enabled": True, "default_permission": "deny", "rules": [only],
        "subjects": [{"id": "local", "interfaces": ["lo"]}],
        "policies": [{"rules": ["own"], "subjects": ["local"]}],
    }))  # fmt: skip
    config.insert_json5("adminspace/enabled", "true")
    with zenoh.open(config) as router:
        (told,) = router.get(f"@/{router.zid()}/router")
        assert told.ok is not None
        (endpoint,) = json.loads(told.ok.payload.to_string())["locators"]
        with zenoh.open(session_config("client", connect=[endpoint])) as session:
            for _ in range(hearing.MISSES):
                question = hearing.Question(session)
                wait_for(question.ended)
                assert question.answered
