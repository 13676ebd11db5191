"""A consumer never goes silent: not by one message of a stranger, not where a gateway lost its store or its clock."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import pytest

from agent.delivery import memory as memory_file
from agent.delivery.consumer import Consumer, Received
from agent.delivery.history import History
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from tests.attacks.chain_site import record as record_run
from tests.unit.zenoh_site import KEY, Site, record, taken_until, wait_for

AHEAD = 2_000_000_000_000  # a number of a gateway with the right clock; others are behind


class Gateway:
    """The outgoing side of an agent, with the epoch of its store in each result."""

    def __init__(self, site: Site, directory: Path, count_from: int | None = None) -> None:
        self.store = Store(directory, count_from)
        self.publisher = Publisher("site", "gw", [site.endpoint], self.store)
        self.publisher.start()

    def send(self, count: int) -> list[int]:
        numbers = [self.store.last_sequence() + 1 + k for k in range(count)]
        for number in numbers:
            result = record(number, "calibration", epoch=self.store.epoch)
            self.store.commit([result])
            self.publisher.publish(result)
        wait_for(lambda: self.store.published() == numbers[-1])
        return numbers

    def stop(self) -> None:
        self.publisher.close()
        self.store.close()


@pytest.fixture
def gateway(site: Site, tmp_path: Path) -> Iterator[Gateway]:
    gateway = Gateway(site, tmp_path / "a", AHEAD)
    yield gateway
    gateway.stop()


def until(consumer: Consumer, last: int) -> list[Received]:
    """The results up to number `last`, confirmed; what has come where it never comes."""
    return taken_until(consumer, lambda result: result.sequence == last and result.confirmed)


def process(site: Site, memory: Path, last: int) -> list[Received]:
    """A consumer that remembers processes results up to number `last`, then ends."""
    with Consumer([site.endpoint], memory=memory) as consumer:
        return until(consumer, last)


@pytest.mark.parametrize("ahead", [5000, 2**62])
@pytest.mark.parametrize("epoch", ["same", "none", "other"])
def test_one_put_of_a_stranger_does_not_silence_a_consumer(
    site: Site, gateway: Gateway, tmp_path: Path, ahead: int, epoch: str
) -> None:
    (first,) = gateway.send(1)
    forged = first + ahead
    with Consumer([site.endpoint], memory=tmp_path / "memory") as consumer, site.client() as stranger:
        results = iter(consumer)
        assert next(results).sequence == first
        named = {"same": gateway.store.epoch, "none": "", "other": "0123456789abcdef"}[epoch]
        payload = record(forged, "calibration", epoch=named).payload
        stranger.put(f"{KEY}/mems/calibration", payload, attachment=str(first))
        told = next(results)
        assert (told.sequence, told.confirmed) == (forged, False)
        genuine = gateway.send(24)
        taken = list(islice(results, 24))
        assert [result.sequence for result in taken] == genuine
        assert all(result.confirmed and not result.new_epoch for result in taken)
        results.close()  # type: ignore[attr-defined]
    again = gateway.send(24)
    taken = process(site, tmp_path / "memory", again[-1])
    # The last one before the restart was not processed, and comes again.
    assert [result.sequence for result in taken] == [genuine[-1], *again]


@pytest.mark.parametrize("when", ["live", "restarted"])
@pytest.mark.parametrize("behind", [30 * 86_400_000, 1], ids=["a month", "1"])
def test_a_lost_store_with_a_clock_behind_is_followed(site: Site, tmp_path: Path, when: str, behind: int) -> None:
    first = Gateway(site, tmp_path / "a", AHEAD)
    before = first.send(20)
    memory = tmp_path / "memory"
    memory_file.save(memory, {f"site/gw/{first.store.epoch}": before[-1]})
    with Consumer([site.endpoint], memory=memory) as consumer:
        first.stop()
        if when == "restarted":
            consumer.close()
        again = Gateway(site, tmp_path / "b", AHEAD - behind)  # with all recordings lost too
        numbers = again.send(30)
        taken = process(site, memory, numbers[-1]) if when == "restarted" else until(consumer, numbers[-1])
    genuine = [result for result in taken if result.epoch == again.store.epoch]
    assert [result.sequence for result in genuine] == numbers, "each once, in order, from the first"
    assert [result.new_epoch for result in genuine] == [True] + [False] * 29
    assert all(result.sequence == before[-1] for result in taken if result not in genuine)
    again.stop()


def test_a_number_without_its_epoch_is_that_of_the_result_in_the_store(site: Site, gateway: Gateway) -> None:
    """As a user gives it, or as an older version remembered it."""
    numbers = gateway.send(12)
    consumer = Consumer([site.endpoint], last_sequence={"site/gw": numbers[4]})
    assert [result.sequence for result in islice(consumer, 7)] == numbers[5:]
    assert consumer.last_sequence[f"site/gw/{gateway.store.epoch}"] == numbers[-1]
    consumer.close()


def test_a_result_that_the_store_gets_later_is_given_once(site: Site, gateway: Gateway) -> None:
    (first,) = gateway.send(1)
    with Consumer([site.endpoint]) as consumer:
        results = iter(consumer)
        assert next(results).sequence == first
        waiting = record(first + 1, "calibration", epoch=gateway.store.epoch)
        gateway.publisher.publish(waiting)  # the disk is full
        assert next(results).sequence == first + 1
        gateway.store.commit([waiting])
        numbers = gateway.send(2)
        assert [result.sequence for result in islice(results, 2)] == numbers


def test_results_made_again_from_recordings_keep_their_epoch(tmp_path: Path) -> None:
    directory = tmp_path / "a"
    record_run(directory, blocks=6)
    store = Store(directory)
    old = store.epoch
    store.close()
    for path in directory.glob("state.sqlite*"):
        path.unlink()
    store = Store(directory)
    assert store.recovered.results > 0
    assert store.epoch != old
    with History(store.path) as history:
        epochs = {json.loads(record.payload)["epoch"] for record in history.after(0, limit=1000)}
        assert epochs == {old}
        assert history.after(0, limit=1, epoch=store.epoch) == []
        assert len(history.after(0, limit=1000, epoch=old)) == store.recovered.results
    store.close()
    again = Store(directory)
    assert (again.epoch, len(again.epoch)) == (store.epoch, 16)
    again.close()
