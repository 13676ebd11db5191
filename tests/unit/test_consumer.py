"""The client library through real sessions: nothing lost, nothing twice, in order, whatever is cut."""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from agent.delivery import questions
from agent.delivery.answers import NOTHING
from agent.delivery.consumer import Consumer, Received
from agent.delivery.keys import PREFIX, narrow, parse_key
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from tests.unit.zenoh_site import Site, record, wait_for


class Gateway:
    """An agent's outgoing side, with numbers that begin at 1 above its store's."""

    def __init__(self, site: Site, directory: Path, name: str = "gw") -> None:
        self.store = Store(directory)
        self.base = self.store.last_sequence()
        self.publisher = Publisher("site", name, [site.endpoint], self.store)
        self._next = 1

    def send(self, count: int, what: str = "window") -> None:
        for _ in range(count):
            result = record(self.base + self._next, what)
            self._next += 1
            self.store.commit([result])
            self.publisher.publish(result)

    def wait_until_out(self) -> None:
        wait_for(lambda: self.store.published() == self.base + self._next - 1)

    def stop(self) -> None:
        self.publisher.close()
        self.store.close()


class Follower:
    """A consumer with its iterating thread; numbers are given back as counted by the gateway."""

    def __init__(self, consumer: Consumer, base: int) -> None:
        self.consumer = consumer
        self._base = base
        self._results: queue.Queue[Received] = queue.Queue()
        self._thread = threading.Thread(target=self._iterate, daemon=True)
        self._thread.start()

    def _iterate(self) -> None:
        for result in self.consumer:
            self._results.put(result)

    def up_to(self, last: int, timeout_s: float = 60.0) -> list[int]:
        """The numbers that come until `last` is there."""
        numbers: list[int] = []
        end = time.monotonic() + timeout_s
        while last not in numbers:
            numbers.append(self._results.get(timeout=end - time.monotonic()).sequence - self._base)
        return numbers

    def stop(self) -> None:
        self.consumer.close()
        self._thread.join(60.0)
        assert not self._thread.is_alive()


def next_query(queryable: zenoh.Queryable[zenoh.Handler[zenoh.Query]]) -> zenoh.Query:
    found: list[zenoh.Query] = []

    def there_is_one() -> bool:
        query = queryable.try_recv()
        found.extend([query] if query else [])
        return bool(found)

    wait_for(there_is_one)
    return found[0]


@pytest.fixture
def gateway(site: Site, tmp_path: Path) -> Iterator[Gateway]:
    gateway = Gateway(site, tmp_path)
    yield gateway
    gateway.stop()


@pytest.mark.slow
def test_a_first_meeting_begins_with_the_values_in_force_then_all(site: Site, gateway: Gateway) -> None:
    gateway.send(3)
    gateway.send(1, "calibration")
    gateway.send(2)
    gateway.publisher.start()
    gateway.wait_until_out()
    follower = Follower(Consumer([site.endpoint]), gateway.base)
    assert follower.up_to(6) == [4, 6]
    gateway.send(300)
    assert follower.up_to(306) == list(range(7, 307))
    follower.stop()


@pytest.mark.slow
def test_who_knows_a_number_gets_all_that_came_after_it(site: Site, gateway: Gateway) -> None:
    gateway.send(1200)
    gateway.publisher.start()
    gateway.wait_until_out()
    consumer = Consumer([site.endpoint], last_sequence={"site/gw": gateway.base + 10})
    follower = Follower(consumer, gateway.base)
    assert follower.up_to(1200) == list(range(11, 1201))
    assert consumer.last_sequence == {"site/gw": gateway.base + 1200}
    follower.stop()


def test_only_the_keys_asked_for_come_and_all_of_them(site: Site, gateway: Gateway) -> None:
    gateway.publisher.start()
    wait_for(lambda: gateway.publisher.state().connected)
    consumer = Consumer([site.endpoint], "fieldcal/v1/*/*/*/calibration", {"site/gw": gateway.base})
    follower = Follower(consumer, gateway.base)
    for _ in range(5):
        gateway.send(4)
        gateway.send(1, "calibration")
    assert follower.up_to(25) == [5, 10, 15, 20, 25]
    follower.stop()


@pytest.mark.slow
def test_a_router_that_dies_and_comes_back_loses_nothing_and_keeps_the_order(site: Site, gateway: Gateway) -> None:
    gateway.publisher.start()
    wait_for(lambda: gateway.publisher.state().connected)
    follower = Follower(Consumer([site.endpoint], last_sequence={"site/gw": gateway.base}), gateway.base)
    for _ in range(2):
        gateway.send(50)
        site.kill()
        gateway.send(150)
        gateway.send(1, "calibration")
        site.restart()
        gateway.send(50)
    assert follower.up_to(502, 30) == list(range(1, 503))
    follower.stop()


def test_an_agent_that_starts_anew_goes_on_and_a_wiped_store_is_not_taken_for_old_news(
    site: Site, tmp_path: Path
) -> None:
    first = Gateway(site, tmp_path / "a")
    first.publisher.start()
    first.send(3)
    first.wait_until_out()
    follower = Follower(Consumer([site.endpoint]), first.base)
    follower.up_to(3)
    first.stop()
    again = Gateway(site, tmp_path / "a")
    assert again.base == first.base + 3
    again.send(2)  # committed before it can publish
    again.publisher.start()
    assert follower.up_to(5) == [4, 5]
    again.stop()
    wiped = Gateway(site, tmp_path / "b")
    wiped.publisher.start()
    wiped.send(2)
    last = wiped.base + 2 - first.base
    assert follower.up_to(last) == [last - 1, last]
    wiped.stop()
    follower.stop()


def test_what_comes_after_a_hole_is_held_until_the_gateway_answers(site: Site, gateway: Gateway) -> None:
    consumer = Consumer([site.endpoint], last_sequence={"site/gw": gateway.base + 2})
    follower = Follower(consumer, gateway.base)
    gateway.send(5)
    with site.client() as other:
        for number in (4, 5):  # as from a cache, while the gateway itself is out of reach
            result = record(gateway.base + number)
            other.put("fieldcal/v1/site/gw/mems/window", result.payload, attachment=str(gateway.base + number - 1))
    with pytest.raises(queue.Empty):
        follower.up_to(5, 1.0)
    gateway.store.mark_published(gateway.base + 5)
    gateway.publisher.start()
    assert follower.up_to(5) == [3, 4, 5]
    follower.stop()


def test_what_the_store_does_not_have_comes_when_the_gateway_says_so(site: Site, gateway: Gateway) -> None:
    follower = Follower(Consumer([site.endpoint], last_sequence={"site/gw": gateway.base}), gateway.base)
    gateway.publisher.start()
    gateway.publisher.publish(record(gateway.base + 1))  # the disk is full, neither is in the store
    assert follower.up_to(1) == [1]
    with site.client() as other:  # as if 2 had been lost on the way
        other.put("fieldcal/v1/site/gw/mems/window", record(gateway.base + 3).payload, attachment=str(gateway.base + 2))
        assert follower.up_to(3) == [3]
    follower.stop()


def test_a_gateway_that_did_not_answer_is_asked_again(site: Site) -> None:
    follower = Follower(Consumer([site.endpoint], last_sequence={"site/gw": 2}), 0)
    with site.client() as other:
        other.put("fieldcal/v1/site/gw/mems/window", record(4).payload, attachment="3")
        with pytest.raises(queue.Empty):
            follower.up_to(4, 0.5)
        answering = other.declare_queryable("fieldcal/v1/site/gw/**", zenoh.handlers.FifoChannel(8))
        with next_query(answering) as query:
            assert query.parameters.get("after") == "2"
            for number in (3, 4):
                query.reply("fieldcal/v1/site/gw/mems/window", record(number).payload)
        with next_query(answering) as query:
            assert query.parameters.get("after") == "4"
            query.reply_err(NOTHING)
        assert follower.up_to(4) == [3, 4]
    follower.stop()


@pytest.mark.slow
def test_what_is_no_result_is_passed_over(site: Site, gateway: Gateway) -> None:
    gateway.publisher.start()
    wait_for(lambda: gateway.publisher.state().connected)
    follower = Follower(Consumer([site.endpoint]), gateway.base)
    with site.client() as other:
        deep, large = b'{"a":' * 100_000, b"x" * 100_000_000
        for payload in (b"", b"\xff", b"[]", b"{}", b'{"sequence": "7"}', deep, large):
            other.put("fieldcal/v1/site/gw/mems/window", payload)
            other.put("fieldcal/v1/a", payload)
        other.put("fieldcal/v1/site/gw/mems/window", b'{"sequence": 9}', attachment=b"\xff")
    gateway.send(1)
    assert follower.up_to(1) == [1]
    follower.stop()


def test_no_router_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agent.delivery.consumer.CONNECT_S", 0.2)
    with pytest.raises(ConnectionError, match=r"no Zenoh router answers at tcp/127\.0\.0\.1:9$"):
        Consumer(["tcp/127.0.0.1:9"])


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("fieldcal/v1/**", "fieldcal/v1/s/g/**"),
        ("fieldcal/v1/*/*/*/calibration", "fieldcal/v1/s/g/*/calibration"),
        ("fieldcal/v1/s/**", "fieldcal/v1/s/g/**"),
        ("fieldcal/v1/s/g/mems/window", "fieldcal/v1/s/g/mems/window"),
        ("fieldcal/v1/**/status", "fieldcal/v1/s/g/**/status"),
    ],
)
def test_a_key_expression_is_narrowed_to_one_gateway(key: str, expected: str) -> None:
    assert narrow(key, "s/g") == expected
    assert zenoh.KeyExpr(key).includes(expected)


def test_keys_are_taken_apart() -> None:
    address = parse_key(f"{PREFIX}/s/g/mems/window")
    assert address is not None
    assert (address.source, address.sensor, address.what) == ("s/g", "mems", "window")
    gateway = parse_key(f"{PREFIX}/s/g/status")
    assert gateway is not None
    assert (gateway.sensor, gateway.what) == ("", "status")
    assert parse_key("fieldcal/v2/s/g/mems/window") is None
    assert parse_key(f"{PREFIX}/s/g") is None


CONSUMING = """
import os, signal, sys, threading, time, traceback
from agent.delivery.consumer import Consumer

def interrupt_while_it_waits(main=threading.main_thread().ident):
    while "get" not in [f.name for f in traceback.extract_stack(sys._current_frames()[main])]:
        time.sleep(0.01)  # polls; the condition decides, and the test ends the process after 30 s
    os.kill(os.getpid(), signal.SIGINT)

consumer = Consumer([sys.argv[1]])
if sys.argv[2] == "iterate":
    threading.Thread(target=interrupt_while_it_waits).start()
    for received in consumer:
        pass
print("ended")
"""


@pytest.mark.one_case
@pytest.mark.parametrize("what", ["iterate", "leave"])
def test_a_consumer_ends_without_a_traceback(site: Site, what: str) -> None:
    command = [sys.executable, "-c", CONSUMING, site.endpoint, what]
    told = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (told.returncode, told.stdout, told.stderr) == (0, "ended\n", "")


def test_gateways_that_do_not_answer_delay_no_other(
    site: Site, gateway: Gateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "ANSWER_S", 60.0)
    with site.client() as stranger, Consumer([site.endpoint]) as consumer:
        silent = stranger.declare_queryable("fieldcal/v1/site/silent-$*/**", zenoh.handlers.FifoChannel(8))
        follower = Follower(consumer, gateway.base)
        for number in range(5):
            with stranger.declare_publisher(f"fieldcal/v1/site/silent-{number}/mems/window") as silently:
                wait_for(lambda silently=silently: silently.matching_status.matching)  # type: ignore[misc]
                silently.put(record(7).payload, attachment="0")
        queries = [next_query(silent) for _ in range(5)]  # none of them is answered
        began_s = time.monotonic()
        gateway.publisher.start()
        gateway.send(3)
        assert follower.up_to(3)[-1] == 3
        assert time.monotonic() - began_s < questions.ANSWER_S / 2
        for query in queries:
            query.drop()
        silent.undeclare()
        follower.stop()
