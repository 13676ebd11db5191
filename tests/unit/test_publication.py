"""Publication through real Zenoh sessions and a real router on loopback."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import psutil
import pytest
import zenoh
from zenoh.ext import AdvancedSubscriber, HistoryConfig, declare_advanced_subscriber

from agent.config.tls import TlsFiles
from agent.delivery import publication
from agent.delivery.history import StoredResult, StoreError
from agent.delivery.publication import Publisher
from agent.delivery.session import EndpointError
from agent.delivery.store import Store
from agent.keys.certificates import issue, make_authority
from agent.keys.files import write_new
from tests.unit.results import clock
from tests.unit.zenoh_site import KEY, Site, record, sequence_of, wait_for

ALL = zenoh.ConsolidationMode.NONE


@pytest.fixture
def publisher(site: Site, store: Store) -> Iterator[Publisher]:
    publisher = Publisher("site", "gw", [site.endpoint], store)
    yield publisher
    publisher.close()


def send(publisher: Publisher, store: Store, *numbers: int, what: str = "window") -> None:
    for number in numbers:
        store.commit([record(number, what)])
        publisher.publish(record(number, what))


def get(client: zenoh.Session, selector: str) -> list[int]:
    return [sequence_of(reply.ok) for reply in client.get(selector, consolidation=ALL) if reply.ok]


Subscriber = zenoh.Subscriber[zenoh.Handler[zenoh.Sample]] | AdvancedSubscriber[zenoh.Handler[zenoh.Sample]]


def samples_up_to(subscriber: Subscriber, last: int) -> list[zenoh.Sample]:
    """All samples until the result `last` is there."""
    samples: list[zenoh.Sample] = []

    def last_is_there() -> bool:
        while (sample := subscriber.try_recv()) is not None:
            samples.append(sample)
        return last in map(sequence_of, samples)

    wait_for(last_is_there)
    return samples


def received(subscriber: Subscriber, last: int) -> list[int]:
    return [sequence_of(sample) for sample in samples_up_to(subscriber, last)]


def numbers_before(samples: list[zenoh.Sample]) -> list[str]:
    return [sample.attachment.to_string() for sample in samples if sample.attachment]


def test_what_is_published_arrives_in_order_as_json_with_the_number_before(
    site: Site, store: Store, publisher: Publisher
) -> None:
    with site.client() as client:
        subscriber = client.declare_subscriber("fieldcal/v1/**", zenoh.handlers.RingChannel(100))
        publisher.start()  # the subscriber is known then before the first result leaves
        wait_for(lambda: publisher.state().connected)
        send(publisher, store, 1, 2)
        send(publisher, store, 3, what="calibration")
        samples = samples_up_to(subscriber, 3)
    assert [sequence_of(s) for s in samples] == [1, 2, 3]
    assert [str(s.key_expr) for s in samples] == [f"{KEY}/mems/{w}" for w in ("window", "window", "calibration")]
    assert {str(s.encoding) for s in samples} == {"application/json"}
    assert numbers_before(samples) == ["0", "1", "2"]
    wait_for(lambda: store.published() == 3)


def test_the_clocks_of_both_devices_are_published_as_json_and_a_late_get_brings_the_sensors(
    site: Site, store: Store, publisher: Publisher
) -> None:
    pair = [
        StoredResult.of(clock(n, device=d), recorded=True, recording="f") for n, d in ((1, "reference"), (2, "mems"))
    ]
    with site.client() as client:
        subscriber = client.declare_subscriber(f"{KEY}/mems/clock", zenoh.handlers.RingChannel(10))
        publisher.start()
        wait_for(lambda: publisher.state().connected)
        store.commit(pair)
        publisher.publish(pair[1])
        told = [json.loads(sample.payload.to_string()) for sample in samples_up_to(subscriber, 2)]
        assert get(client, f"{KEY}/mems/clock") == [2]
        assert get(client, f"{KEY}/mems/clock?after=0") == [1, 2]
    assert [(fields["device"], fields["lag_s"]) for fields in told] == [("reference", None), ("mems", 2.5e-3)]
    assert set(told[0]) == {
        "run_id", "sequence", "sensor", "t_utc_ns", "device", "role", "nominal_rate_hz", "rate_hz", "u_rate_hz",
        "offset_s", "u_offset_s", "jitter_s", "lag_s", "u_lag_s", "arrivals", "recorded", "engine",
    }  # fmt: skip


def test_the_gateway_speaks_for_itself_under_its_own_key(site: Site, store: Store, publisher: Publisher) -> None:
    store.commit([record(1, "status", sensor="")])
    with site.client() as client:
        subscriber = client.declare_subscriber(f"{KEY}/status", zenoh.handlers.RingChannel(10))
        publisher.start()
        assert received(subscriber, 1) == [1]
        assert get(client, f"{KEY}/status") == [1]


def test_a_late_subscriber_gets_the_calibration_in_force_also_of_a_run_before(
    site: Site, store: Store, publisher: Publisher
) -> None:
    store.commit([record(1, "calibration"), record(2, "calibration"), record(3, "status", status="VALID")])
    store.mark_published(3)
    publisher.start()
    wait_for(lambda: publisher.state().connected)
    with site.client() as client:
        history = HistoryConfig(detect_late_publishers=True, max_samples=1)
        subscriber = declare_advanced_subscriber(
            client, f"{KEY}/*/calibration", zenoh.handlers.RingChannel(10), history=history
        )
        assert received(subscriber, 2) == [2]
        subscriber.undeclare()


def test_a_plain_get_gives_the_value_in_force_and_nothing_when_uncalibrated(
    site: Site, store: Store, publisher: Publisher
) -> None:
    publisher.start()
    wait_for(lambda: publisher.state().connected)
    store.commit([record(1, "calibration"), record(2), record(3, "calibration"), record(4, "status", status="VALID")])
    with site.client() as client:
        assert get(client, f"{KEY}/mems/calibration") == [3]
        assert get(client, f"{KEY}/**") == [2, 3, 4]
        assert get(client, "fieldcal/v1/*/*/*/status") == [4]
        assert get(client, "fieldcal/v1/other/**") == []
        store.commit([record(5, "status", status="UNCALIBRATED")])
        assert get(client, f"{KEY}/mems/calibration") == []


def test_after_gives_all_later_results_of_the_keys_in_order_bounded(
    site: Site, store: Store, publisher: Publisher
) -> None:
    store.commit([record(n, "calibration" if n % 100 == 0 else "window") for n in range(1, 1202)])
    store.mark_published(1201)
    publisher.start()
    wait_for(lambda: publisher.state().connected)
    with site.client() as client:
        assert get(client, f"{KEY}/**?after=1100") == list(range(1101, 1202))
        assert get(client, f"{KEY}/**?after=0") == list(range(1, 501))
        assert get(client, f"{KEY}/mems/calibration?after=250") == list(range(300, 1201, 100))
        assert get(client, f"{KEY}/**?after=1201") == []
        for bad in ("", "-1", "x", "9" * 30):
            (reply,) = client.get(f"{KEY}/**?after={bad}")
            assert reply.err is not None
            assert reply.err.payload.to_string() == f"after={bad}: not a sequence number"


def test_without_a_router_results_wait_in_the_outbox_and_leave_in_order(
    site: Site, store: Store, publisher: Publisher
) -> None:
    publisher.start()
    wait_for(lambda: publisher.state().connected)
    send(publisher, store, 1)
    wait_for(lambda: store.published() == 1)
    site.kill()
    wait_for(lambda: not publisher.state().connected)
    send(publisher, store, *range(2, 60), what="window")
    send(publisher, store, 60, what="calibration")
    assert store.published() == 1
    site.restart()
    with site.client() as client:
        # The agent may be back before this client: history brings what it put by then.
        subscriber = declare_advanced_subscriber(
            client, f"{KEY}/mems/window", zenoh.handlers.RingChannel(100), history=HistoryConfig()
        )
        assert [number for number in received(subscriber, 59) if number > 1] == list(range(2, 60))
        wait_for(lambda: store.published() == 60)
        assert get(client, f"{KEY}/**?after=1") == list(range(2, 61))
        subscriber.undeclare()


@pytest.mark.slow
def test_what_a_dying_router_did_not_take_stays_in_the_outbox(site: Site, store: Store, publisher: Publisher) -> None:
    store.commit([record(n) for n in range(1, 20_001)])
    publisher.start()
    wait_for(lambda: store.published() >= 100)
    site.kill()
    wait_for(lambda: not publisher.state().connected)
    assert store.published() < 20_000
    site.restart()


@pytest.mark.slow
def test_close_does_not_wait_for_a_long_backlog(store: Store, publisher: Publisher) -> None:
    store.commit([record(n) for n in range(1, 50_001)])
    publisher.start()
    wait_for(lambda: store.published() >= 100)
    assert publisher.close(60.0)
    assert 100 <= store.published() < 50_000


def test_a_result_that_the_store_refuses_still_leaves(site: Site, store: Store, publisher: Publisher) -> None:
    with site.client() as client:
        subscriber = client.declare_subscriber("fieldcal/v1/**", zenoh.handlers.RingChannel(1000))
        publisher.start()
        send(publisher, store, 1)
        store._connection.execute("PRAGMA max_page_count = 1")
        refused = record(2, text="x" * 20_000)
        with pytest.raises(StoreError, match="full"):
            store.commit([refused])
        publisher.publish(refused)
        samples = samples_up_to(subscriber, 2)
        assert [sequence_of(s) for s in samples] == [1, 2]
        assert numbers_before(samples) == ["0", "0"], "a consumer must ask the store what came before 2"
        wait_for(lambda: store.published() == 1)
        store._connection.execute("PRAGMA max_page_count = 100000")
        send(publisher, store, 3)
        assert received(subscriber, 3) == [2, 3], "what is kept late goes out again, in order"


def test_the_liveliness_token_is_there_while_the_agent_is(site: Site, publisher: Publisher) -> None:
    with site.client() as client:
        # With the history: nobody knows when the router has the subscription, and the token may be there before.
        watch = client.liveliness().declare_subscriber(
            "fieldcal/v1/*/*/alive", zenoh.handlers.RingChannel(10), history=True
        )
        changes: list[zenoh.Sample] = []

        def changed(count: int) -> bool:
            sample = watch.try_recv()
            changes.extend([sample] if sample else [])
            return len(changes) == count

        publisher.start()
        wait_for(lambda: changed(1))
        publisher.close()
        wait_for(lambda: changed(2))
    assert [str(change.key_expr) for change in changes] == [f"{KEY}/alive"] * 2
    assert [change.kind for change in changes] == [zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE]


def test_publish_does_not_wait_and_close_is_bounded_without_a_router(store: Store) -> None:
    publisher = Publisher("site", "gw", ["tcp/127.0.0.1:9"], store)
    publisher.start()
    begin = time.monotonic()
    for number in range(1, 2001):
        publisher.publish(record(number))
    publisher.close()
    assert time.monotonic() - begin < 9.0  # a session without a router opens, and closes, in 10 s


def test_an_agent_leaves_nothing_open_behind(site: Site, store: Store) -> None:
    """The router is in this process too, and closes its ends of the connections when it likes: at first some may still
    be open, but not as many as ten agents would leave."""

    def once() -> None:
        publisher = Publisher("site", "gw", [site.endpoint], store)
        publisher.start()
        wait_for(lambda: publisher.state().connected)
        publisher.close()

    def open_files() -> int:
        return psutil.Process().num_fds()

    store.commit([record(1)])
    once()
    before = open_files()
    for _ in range(10):
        once()
    wait_for(lambda: open_files() <= before)


@pytest.mark.parametrize("name", ["", "a/b", "a*", "$x", "@gw", "ä", "a b", ".", "x" * 64])
def test_a_name_that_cannot_be_in_a_key_is_refused(store: Store, name: str) -> None:
    with pytest.raises(ValueError, match="cannot be part of a Zenoh key"):
        Publisher("site", name, [], store)


def test_an_endpoint_that_is_none_is_refused(store: Store) -> None:
    with pytest.raises(EndpointError, match=r"^not an endpoint: router7447: .* as in tcp/192.0.2.1:7447$"):
        Publisher("site", "gw", ["router7447"], store)


def test_an_endpoint_of_an_unknown_protocol_is_refused(store: Store) -> None:
    with pytest.raises(EndpointError, match="Zenoh has no protocol 'carrier'"):
        Publisher("site", "gw", ["carrier/pigeon:1"], store)


def test_a_certificate_that_is_about_to_expire_is_told_while_the_gateway_runs(
    site: Site, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publication, "EXPIRY_S", 0.0)
    authority = make_authority("authority", 400, datetime.now(UTC))
    files = TlsFiles(*(str(tmp_path / name) for name in ("ca.pem", "gateway.pem", "gateway.key")))

    def put(days: int) -> None:
        made = issue(authority, "gateway", days, datetime.now(UTC))
        write_new(tmp_path, {"gateway.key": made.key_pem, f"{days}.pem": made.certificate_pem})
        (tmp_path / f"{days}.pem").replace(files.certificate)

    write_new(tmp_path, {"ca.pem": authority.certificate_pem})
    put(300)
    publisher = Publisher("site", "gw", [site.endpoint], store, tls=files)
    publisher.start()
    try:
        wait_for(lambda: publisher.state().connected)
        assert publisher.state().fault == ""
        Path(files.key).unlink()
        put(40)  # as 260 days later
        wait_for(lambda: "gateway.pem: expires in 39 days, on " in publisher.state().fault)
        Path(files.key).unlink()
        put(365)  # renewed
        wait_for(lambda: publisher.state().fault == "")
    finally:
        publisher.close()
