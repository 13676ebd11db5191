"""What messages of strangers may cost a consumer is bounded, and what it drops is counted."""

from __future__ import annotations

import logging
import time
from itertools import islice
from pathlib import Path

import pytest
import zenoh

from agent.delivery import holding
from agent.delivery.answers import NOTHING
from agent.delivery.consumer import Consumer
from agent.delivery.holding import AT_ONCE, GATEWAYS_MAX, RESULTS_MAX, WaitingResults
from agent.delivery.received import Received, receive
from tests.attacks.chain_site import KEY
from tests.attacks.signed_site import PLACE, Gateway, listed, signed_record, signer_of, taken
from tests.unit.results import calibration
from tests.unit.zenoh_site import Site, record, wait_for

EPOCH = "00c0ffee00c0ffee"


def received(gateway: str, sequence: int) -> Received:
    found = receive(f"fieldcal/v1/site/{gateway}/mems/window", record(sequence).payload, b"5")
    assert found is not None
    return found


def test_gateways_that_do_not_exist_take_a_bounded_place() -> None:
    held = WaitingResults()
    for number in range(GATEWAYS_MAX + 300):
        held.add(received(f"gw-{number}", 7))
    assert held.dropped == {"": 300}
    for _ in range(3):
        asked = held.due()
        assert len(asked) == AT_ONCE // 2  # none of them is known
        assert held.wait_s() is None
        for source in asked:
            held.asked(source, answered=False, known=False)
            held.ended(source)


def test_results_of_one_gateway_take_a_bounded_place() -> None:
    held = WaitingResults()
    for number in range(RESULTS_MAX + 30):
        held.add(received("gw", 5000 - number))
    assert held.dropped == {"site/gw": 30}
    assert [result.sequence for result in held.pop("site/gw")] == list(range(5001 - RESULTS_MAX - 30, 4971))


def test_a_gateway_that_never_answered_is_asked_less_and_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, held, asked = [0.0], WaitingResults(), []
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    held.add(received("gw", 7))
    while now_s[0] < 100.0:
        for source in held.due():
            asked.append(now_s[0])
            assert not held.asked(source, answered=False, known=False)
            held.ended(source)
        now_s[0] += 0.5
    assert asked == [0.0, 2.0, 6.0, 14.0, 30.0, 60.0, 90.0]


def test_a_thousand_messages_ahead_cost_a_gateway_a_query_a_second(site: Site) -> None:
    """Each message claims that others before it are missing."""
    queries: list[str] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            queries.append(str(query.parameters))
            query.reply_err(NOTHING)

    with site.client() as gateway, Consumer([site.endpoint], last_sequence={"site/gw": 5}) as consumer:
        gateway.declare_queryable("fieldcal/v1/site/gw/**", answer)
        publisher = gateway.declare_publisher(PLACE)
        wait_for(lambda: publisher.matching_status.matching)  # type: ignore[attr-defined]
        began_s = time.monotonic()
        for number in range(100, 1100):
            publisher.put(record(number, "calibration").payload, attachment=str(number - 1))
        told = list(islice(consumer, 100))
        spent_s = time.monotonic() - began_s
    assert not any(result.confirmed for result in told)
    assert 0 < len(queries) <= 2 + spent_s


def test_signed_results_of_a_gateway_that_never_answers_come_late_and_are_told(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The gateway is gone, or a router withholds its answers; the results before these were lost on the way."""
    monkeypatch.setattr(holding, "GIVE_UP_S", 1.5)
    signer = signer_of("site/gw", EPOCH, KEY)
    records = [signed_record(calibration(number), signer, EPOCH) for number in (7, 8, 9)]
    keys = listed(tmp_path / "known.keys", KEY)
    with (
        caplog.at_level(logging.WARNING),
        Consumer([site.endpoint], last_sequence={f"site/gw/{EPOCH}": 5}, keys=keys) as consumer,
        site.client() as network,
    ):
        for one in records:
            attachment = f"{one.sequence - 1}\n".encode() + one.signed
            network.put(PLACE, one.payload, attachment=attachment)
        began_s = time.monotonic()
        given = taken(consumer, 9)
        assert time.monotonic() - began_s > 1.5
        assert consumer.last_sequence == {f"site/gw/{EPOCH}": 5}, "what is missing is still asked for"
    assert [(result.sequence, result.confirmed) for result in given] == [(7, False), (8, False), (9, False)]
    assert all(result.signed_by for result in given)
    assert "site/gw does not answer: its results are held" in caplog.text


def test_a_flood_of_unsigned_messages_delays_no_signed_result(site: Site, tmp_path: Path) -> None:
    gateway = Gateway(site, tmp_path / "a")
    with (
        Consumer([site.endpoint], keys=listed(tmp_path / "known.keys", KEY)) as consumer,
        site.client() as stranger,
    ):
        results = iter(consumer)
        first = gateway.send(1)
        assert [next(results).sequence] == first
        for number in range(3000):
            stranger.put(f"fieldcal/v1/site/gw-{number}/mems/window", record(7).payload, attachment="6")
        numbers = gateway.send(5)
        assert [result.sequence for result in islice(results, 5)] == numbers
        wait_for(lambda: sum(consumer.refused.values()) > 0)
        assert len(consumer.refused) <= 1001
    gateway.stop()
