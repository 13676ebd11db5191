"""The monitor goes on: hostile results, a locked database, faults of its own; and says what it could not take."""

from __future__ import annotations

import csv
import logging
import socket
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

from agent.delivery.history import StoredResult
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from tests.attacks.hostile_bus import HostileGateway, messages, payloads, put_all
from tests.unit.zenoh_site import Site, record, wait_for

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
from agent.monitor import engines, following, live, server
from agent.monitor.fleet import Fleet
from agent.monitor.following import Following
from tests.attacks.monitor_pages import bus, pages, shown
from tests.unit.monitor_site import Served

HOSTILE_RESULTS, HOSTILE_MESSAGES = 5000, 5000  # `python -m benchmarks.hostile_bus` asks for the pages meanwhile


class Sender:
    """A gateway that publishes whatever it is given."""

    def __init__(self, site: Site, directory: Path, name: str = "gw") -> None:
        self.store = Store(directory / name)
        self.publisher = Publisher("site", name, [site.endpoint], self.store)
        self.publisher.start()

    def next(self) -> int:
        return self.store.last_sequence() + 1

    def send(self, *records: StoredResult) -> None:
        self.store.commit(records)
        for each in records:
            self.publisher.publish(each)

    def close(self) -> None:
        self.publisher.close()
        self.store.close()


@pytest.fixture
def gateway(site: Site, tmp_path: Path) -> Iterator[Sender]:
    with closing(Sender(site, tmp_path, "good")) as sender:
        yield sender


@pytest.fixture
def served(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.setattr(engines, "BUSY_S", 0.1)
    monkeypatch.setattr(following, "AGAIN_S", 0.1)
    with Served(site, tmp_path / "monitor") as server:
        yield server


def test_a_number_beyond_64_bits_costs_its_own_result_alone(served: Served, gateway: Sender) -> None:
    gateway.send(record(gateway.next(), "status", "first"))
    wait_for(lambda: shown(served) == {"first": "VALID"})
    assert (bus(served)["fault"], bus(served)["malformed"]) == ("", 0)
    gateway.send(record(gateway.next(), "status", more=10**30))
    gateway.send(record(gateway.next(), "status", t_utc_ns=-(2**70)))
    gateway.send(record(gateway.next(), "window", calibration=5))  # not the field of a window; it is kept
    gateway.send(record(gateway.next(), "status", "last"))
    wait_for(lambda: shown(served) == {"first": "VALID", "mems": "", "last": "VALID"})
    told = bus(served)
    assert (told["malformed"], told["faults"]) == (2, 0)  # each once, though it may come again from the store
    assert "malformed messages in the place of results were left out; the last good result came " in told["fault"]
    assert 0 <= told["last_result_age_s"] < 10


def test_a_page_of_malformed_results_hides_none_after_it(site: Site, gateway: Sender, tmp_path: Path) -> None:
    """500 results are one answer of a gateway's store; here the monitor was away while it got 600."""
    first = gateway.next()
    gateway.send(record(first, "status"))
    with Served(site, tmp_path / "monitor") as served:
        wait_for(lambda: shown(served) == {"mems": "VALID"})
    gateway.send(
        *(record(first + k, "status", more=10**30) for k in range(1, 601)), record(first + 601, "status", "last")
    )
    wait_for(lambda: gateway.store.published() == first + 601)
    with Served(site, tmp_path / "monitor") as served:
        wait_for(lambda: shown(served).get("last") == "VALID")


@pytest.mark.thorough
def test_hostile_results_names_and_payloads_leave_page_and_threads(
    site: Site, served: Served, gateway: Sender, caplog: pytest.LogCaptureFixture
) -> None:
    logging.disable(logging.NOTSET)
    with closing(HostileGateway(site, "gw")) as hostile:
        for what, payload in payloads(1, HOSTILE_RESULTS, 1):
            hostile.publish("mems", what, payload)
        with site.client() as stranger:
            put_all(stranger, messages(2, HOSTILE_MESSAGES))
        gateway.send(record(gateway.next(), "status", "last"))
        wait_for(lambda: shown(served).get("last") == "VALID" and bus(served)["malformed"] > 0)
        hostile.publish("mems", "status", record(HOSTILE_RESULTS + 1, "status", "mems", status="INVALID").payload)
        wait_for(lambda: shown(served).get("mems") == "INVALID")
    told = bus(served)
    assert told["faults"] == 0, told
    assert told["malformed"] > HOSTILE_RESULTS // 4
    for path in pages("mems"):
        answer = served.ask(path)
        assert answer.status == 200, (path, answer.text)
        if path.startswith("/api"):
            msgspec.json.decode(answer.text)  # which knows no NaN, as a browser
    assert len(caplog.records) < 20, [one.getMessage()[:200] for one in caplog.records]


def test_a_fault_of_the_program_costs_one_result_and_is_told(
    served: Served, gateway: Sender, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever raises in the database or in the fleet: the others of its batch are taken."""
    add, take = served.database.add, served.fleet.take

    def failing_add(results: Any) -> None:
        if any(result.address.sensor.startswith("bad") for result in results):
            raise KeyError("a fault in the database")
        add(results)

    def failing_take(site: str, name: str, sensor: str, what: str, fields: dict[str, Any]) -> None:
        if sensor == "worse":
            raise ZeroDivisionError("a fault in the fleet")
        take(site, name, sensor, what, fields)

    monkeypatch.setattr(served.database, "add", failing_add)
    monkeypatch.setattr(served.fleet, "take", failing_take)
    first = gateway.next()
    names = ("bad1", "a", "worse", "b", "bad2", "c")
    gateway.send(*(record(first + k, "status", name) for k, name in enumerate(names)))
    wait_for(lambda: shown(served) == dict.fromkeys("abc", "VALID"))
    told = bus(served)
    assert told["faults"] == 3
    assert "3 results or messages were left out by a fault of this program" in told["fault"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_the_page_says_where_the_bus_is_not_followed_any_more(
    site: Site, served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ends(_: Following) -> None:
        raise SystemExit

    with ExitStack() as opened:
        monkeypatch.setattr(Following, "_follow", ends)
        follower = Following([site.endpoint], None, served.database, served.fleet)
        opened.callback(follower.close)
        wait_for(lambda: follower.state()["fault"] == "the bus is not followed any more: start the monitor again")
    assert follower.state()["fault"] == ""  # it was to end


def test_a_locked_database_is_told_and_nothing_is_lost(served: Served, gateway: Sender, tmp_path: Path) -> None:
    gateway.send(record(gateway.next(), "status", "before"))
    wait_for(lambda: shown(served) == {"before": "VALID"})
    with closing(sqlite3.connect(tmp_path / "monitor" / "monitor.sqlite", isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        first = gateway.next()
        gateway.send(*(record(first + k, "window", "mems") for k in range(250)))
        wait_for(lambda: "results are not kept, and wait: database is locked" in bus(served)["fault"])
        assert "before" in shown(served)
        other.execute("COMMIT")
    kept = "/api/history?site=site&gateway=good&sensor=mems&what=window"
    wait_for(lambda: len(served.ask(kept).json) == 250)
    assert bus(served)["fault"] == ""
    assert [row["sequence"] for row in served.ask(kept).json] == list(range(first, first + 250))


def test_a_full_disk_is_told_and_nothing_is_lost(served: Served, gateway: Sender) -> None:
    gateway.send(record(gateway.next(), "status", "before"))
    wait_for(lambda: shown(served) == {"before": "VALID"})
    with served.database._engine.transaction() as run:  # as much as SQLite may write, in place of the disk
        ((pages,),) = run("PRAGMA page_count")
        run(f"PRAGMA max_page_count = {pages}")
    first = gateway.next()
    gateway.send(*(record(first + k, "calibration", "mems") for k in range(100)))
    wait_for(lambda: "results are not kept, and wait: database or disk is full" in bus(served)["fault"])
    with served.database._engine.transaction() as run:
        run("PRAGMA max_page_count = 1000000")
    kept = "/api/history?site=site&gateway=good&sensor=mems&what=calibration"
    wait_for(lambda: len(served.ask(kept).json) == 100)
    assert bus(served)["fault"] == ""


def test_a_database_that_cannot_be_read_is_told_in_one_line(served: Served, tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "monitor" / "monitor.sqlite", isolation_level=None)) as other:
        other.execute("DROP TABLE summary")
    answer = served.ask("/api/hours?site=site&gateway=gw&sensor=mems")
    assert (answer.status, answer.text) == (
        503, "the database cannot be read: no such table: summary; try again")  # fmt: skip


def test_no_cell_of_a_table_is_a_formula(served: Served, gateway: Sender) -> None:
    """Names of fields become headings, and a spreadsheet may separate cells by other characters than the file."""
    formulas = ("=1+1", "+1", "-1+1", "@x", "\t=1", "\r=1", "a;=1+1", "a\t=1", "a,=1", "a\n=1", "\uff1d1")
    texts = {formula: formula for formula in formulas}
    gateway.send(record(gateway.next(), "status", reason="=1+1", numbers=list(texts), **texts))
    wait_for(lambda: shown(served) == {"mems": "VALID"})
    text = served.ask("/sensor.csv?site=site&gateway=good&sensor=mems&what=status").text
    rows = list(csv.reader(text.splitlines(keepends=True)))
    assert len(rows) == 2
    for separator in ",;\t\n\r":
        for cell in [cell for row in rows for whole in row for cell in whole.split(separator)]:
            assert not cell.startswith(("=", "+", "-", "@", "\uff1d")), (separator, cell)


def test_a_status_of_a_gateway_with_a_huge_number_leaves_the_page(served: Served, site: Site) -> None:
    huge = ("1" + "0" * 30, str(2**64), "-1" + "0" * 400)
    with site.client() as stranger:

        def told() -> list[str]:
            """Put again at each look, since the first messages may come before the monitor subscribes."""
            for number in (*huge, "1"):
                name = "gw2" if number == "1" else "gw"
                data = f'{{"state": "running", "reasons": [], "t_utc_ns": {number}}}'
                stranger.put(f"fieldcal/v1/site/{name}/status", data.encode())
            return [row["gateway"] for row in served.ask("/api/fleet").json["gateways"]]

        wait_for(lambda: told() == ["gw2"])


def test_what_is_damaged_in_the_database_costs_one_row_at_the_start(site: Site, tmp_path: Path) -> None:
    with closing(Sender(site, tmp_path)) as gateway, Served(site, tmp_path / "monitor") as served:
        gateway.send(record(gateway.next(), "status", "a"), record(gateway.next() + 1, "status", "b"))
        wait_for(lambda: len(shown(served)) == 2)
    with closing(sqlite3.connect(tmp_path / "monitor" / "monitor.sqlite", isolation_level=None)) as other:
        other.execute("UPDATE result SET payload = x'00' WHERE number = 1")
    with Served(site, tmp_path / "monitor") as served:
        assert shown(served) == {"b": "VALID"}
        assert bus(served)["fault"] == "1 damaged results of the database were left out"


ORIGINS = ("http://[", "http://]", "http://[::1", "http://[v1.x]", "//", "http://\u2100.example", "[", "x" * 9000,
           "http://127.0.0.1:99999999")  # fmt: skip
HOSTS = ("[127.0.0.1]", "[1.2.3.4]:80", "::1", "[::1", "[]", "1.2.3", "127.0.0.1:", "[fe80::1%eth0]", "0x7f.1", "127.1")
COOKIES = ("fieldcal", "=", ";;;=;", "fieldcal=\xff\xfe", 'fieldcal="\\777\\x', "a=" * 3000, "fieldcal=" + "x" * 9000)
QUERIES = ("limit=%D9%A3", "limit=-1", "limit=1e9", "limit=" + "9" * 500, "site=%ff%00&sensor=%ed%a0%80", "&&=&%",
           "what=%", "site=a&site=b", "=" * 3000, "site[]=1", "limit=%C2%B2")  # fmt: skip
OTHERS = (("Range", "bytes=0-,1-,2-"), ("Range", "bytes=9999999999999999999999-"), ("If-None-Match", '"'),
          ("If-Modified-Since", "\xff"), ("Expect", "100-continue"), ("Accept-Encoding", "gzip;q=x" * 500),
          ("Upgrade", "websocket"), ("X-Forwarded-For", "\xff, [::"), ("Forwarded", "for=["))  # fmt: skip
LENGTHS = ("-1", "1e3", "0x10", "9" * 400, "1, 2", "+1", "\u0663")


def test_whatever_changes_in_a_row_changes_its_stamp_also_over_a_restart() -> None:
    """By its stamp a page leaves rows alone that have not changed."""
    before = stamps_rise(Fleet(), 0)
    wait_for(lambda: Fleet().version > before)  # a restart takes longer than a millisecond for each change before it
    stamps_rise(Fleet(), before)


def stamps_rise(fleet: Fleet, before: int) -> int:
    steps: list[Callable[[], None]] = [
        lambda: fleet.take("site", "gw", "mems", "status", {"status": "VALID", "reason": "", "t_utc_ns": 1}),
        lambda: fleet.set_alive("site", "gw", True),
        lambda: fleet.set_gateway_status("site", "gw", b'{"state": "degraded", "reasons": ["x"], "t_utc_ns": 1}'),
        lambda: fleet.take("site", "gw", "mems", "status", {"status": "HELD", "reason": "", "t_utc_ns": 2}),
        lambda: fleet.set_alive("site", "gw", False),
    ]
    for step in steps:
        step()
        (first,) = fleet.rows()
        (again,) = fleet.rows()
        assert before < first["changed"] == again["changed"]
        before = first["changed"]
    return before


REQUESTS = (b"", b"\r\n\r\n", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
            b"GET", b"\xff" * 999,
            b"GET / HTTP/9.9\r\n\r\n", b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n",
            b"GET http://evil.example.org/ HTTP/1.1\r\nHost: localhost\r\n\r\n", b"CONNECT a:1 HTTP/1.1\r\n\r\n",
            b"GET / HTTP/1.0\r\n\r\n", b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"a: b\r\n" * 9000 + b"\r\n",
            b"POST /api/login HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\nContent-Length: 1\r\n"
            b"Content-Length: 2\r\n\r\n{}", b"GET /\x00 HTTP/1.1\r\n\r\n", b"GET / HTTP/1.1\r\nHost\x00: a\r\n\r\n",
            b"POST /api/login HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\nTransfer-Encoding: chunked\r\n"
            b"\r\nfffffffffffffffffffff\r\n")  # fmt: skip


def test_what_is_no_request_is_refused_and_does_not_fill_the_log(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    logging.disable(logging.NOTSET)
    host, port = served.address.split(":")
    for request in REQUESTS * 3:
        with closing(socket.create_connection((host, int(port)), 5)) as connection, suppress(ConnectionError):
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            answer = connection.recv(100)
            assert not answer or answer.split()[1] in (b"400", b"404", b"405"), request
    assert len(caplog.records) <= 3, [one.getMessage() for one in caplog.records]
    assert served.ask("/api/fleet").status == 200


@pytest.mark.parametrize("path", ["changes", "live?site=site&gateway=gw&sensor=mems"])
def test_streams_are_bounded_also_where_many_come_at_once_and_end_with_their_readers(
    served: Served, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    monkeypatch.setattr(server, "LISTENERS_MAX", 3)
    monkeypatch.setattr(live, "STREAMS_MAX", 3)
    asked = f"GET /api/{path} HTTP/1.1\r\nHost: {served.address}\r\nConnection: close\r\n\r\n".encode()
    for _ in range(2):
        with ExitStack() as opened:
            readers: list[socket.socket] = []
            wait_for(partial(three_go_on, readers, partial(asking, served, asked, opened)))


def three_go_on(readers: list[socket.socket], ask: Callable[[], socket.socket]) -> bool:
    """Whether so many answers go on. Twenty ask where fewer do: streams of the round before may hold places."""
    readers[:] = filter(goes_on, readers)
    if len(readers) < 3:
        readers += [ask() for _ in range(20)]
        return False
    return len(readers) == 3


def asking(served: Served, request: bytes, opened: ExitStack) -> socket.socket:
    reader = opened.enter_context(closing(connected(served)))
    reader.sendall(request)
    return reader


def goes_on(reader: socket.socket) -> bool:
    """Whether the server has not ended its answer yet."""
    reader.setblocking(False)
    with suppress(BlockingIOError):
        while reader.recv(1000):
            pass
        return False
    return True


def connected(served: Served) -> socket.socket:
    host, port = served.address.split(":")
    return socket.create_connection((host, int(port)), 5)


def test_headers_are_refused_and_not_a_fault(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    logging.disable(logging.NOTSET)
    own = f"http://{served.address}"
    for origin in (*ORIGINS, f"{own}/", f"{own}@"):
        answer = served.ask("/api/login", "POST", b"{}", {"Origin": origin.encode().decode("latin-1")})
        assert (answer.status, "another page" in answer.text) == (400, True), origin
    assert [served.ask("/api/me", headers={"Host": host}).status for host in HOSTS] == [400] * len(HOSTS)
    for cookie in COOKIES:
        assert served.ask("/api/me", headers={"Cookie": cookie}).status == 200, cookie
    for query in QUERIES:
        for path in ("/api/history", "/api/hours", "/api/spread", "/sensor.csv", "/api/advice", "/api/bench"):
            assert served.ask(f"{path}?{query}").status == 200, (path, query)
    for header, value in OTHERS:
        assert served.ask("/api/fleet", headers={header: value, "Connection": "upgrade"}).status == 200, header
    for length in LENGTHS:
        given = {"Origin": own, "Content-Length": length.encode().decode("latin-1")}
        assert served.ask("/api/login", "POST", b"", given).status == 400, length
    assert [one.getMessage() for one in caplog.records if one.levelno >= logging.ERROR] == []
