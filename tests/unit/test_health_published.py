"""The gateway's own status on the network: only the newest, for who listens, who comes late and who asks."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import zenoh
from zenoh.ext import HistoryConfig, declare_advanced_subscriber

from agent.delivery.consumer import Consumer
from agent.delivery.history import History
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from tests.unit.zenoh_site import KEY, Site, record, wait_for


@pytest.fixture
def publisher(site: Site, store: Store) -> Iterator[Publisher]:
    publisher = Publisher("site", "gw", [site.endpoint], store)
    yield publisher
    publisher.close()


def status(client: zenoh.Session, selector: str = f"{KEY}/status") -> list[str]:
    replies = client.get(selector, consolidation=zenoh.ConsolidationMode.NONE)
    return [reply.ok.payload.to_string() for reply in replies if reply.ok]


def test_who_listens_gets_each_and_who_comes_late_the_newest(site: Site, publisher: Publisher) -> None:
    with site.client() as client:
        subscriber = client.declare_subscriber(f"{KEY}/status", zenoh.handlers.RingChannel(10))
        publisher.start()
        wait_for(lambda: publisher.state().connected)
        for told in ('{"n": 1}', '{"n": 2}'):
            publisher.tell_status(told.encode())
            assert subscriber.recv().payload.to_string() == told
        late = declare_advanced_subscriber(
            client, f"{KEY}/status", zenoh.handlers.RingChannel(10), history=HistoryConfig()
        )
        sample = late.recv()
        assert (sample.payload.to_string(), str(sample.encoding)) == ('{"n": 2}', "application/json")
        assert late.try_recv() is None
        late.undeclare()


def test_a_plain_get_brings_it_and_a_question_for_results_does_not(
    site: Site, store: Store, publisher: Publisher
) -> None:
    store.commit([record(1)])
    publisher.start()
    wait_for(lambda: publisher.state().connected)
    with site.client() as client:
        assert status(client) == []
        publisher.tell_status(b'{"n": 1}')
        assert status(client) == ['{"n": 1}']
        assert len(status(client, f"{KEY}/**")) == 2
        assert len(status(client, f"{KEY}/**?after=0")) == 1
        assert status(client, f"{KEY}/mems/status") == []
        assert status(client, f"{KEY}/status?after=0") == []


def test_the_last_word_leaves_before_the_session_closes(site: Site, publisher: Publisher) -> None:
    with site.client() as client:
        subscriber = client.declare_subscriber(f"{KEY}/status", zenoh.handlers.RingChannel(10))
        publisher.start()
        wait_for(lambda: publisher.state().connected)
        publisher.tell_status(b'{"state": "stopping"}')
        assert publisher.close()
        assert subscriber.recv().payload.to_string() == '{"state": "stopping"}'


def test_it_is_no_result_for_a_consumer(site: Site, store: Store, publisher: Publisher) -> None:
    publisher.start()
    wait_for(lambda: publisher.state().connected)
    publisher.tell_status(b'{"state": "running"}')
    with Consumer([site.endpoint], "fieldcal/v1/**", {"site/gw": 0}) as consumer:
        store.commit([record(1)])
        publisher.publish(record(1))
        assert next(iter(consumer)).sequence == 1


def test_the_outbox_is_counted(store: Store) -> None:
    store.commit([record(n) for n in (3, 4, 9)])
    with History(store.path) as history:
        assert [history.count_after(n) for n in (0, 3, 8, 9)] == [3, 2, 1, 0]
