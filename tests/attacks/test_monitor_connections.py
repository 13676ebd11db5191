"""Clients of the fleet page that send nothing, or slowly, or take nothing: they are bounded, others are served."""

from __future__ import annotations

import logging
import select
import socket
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from tests.unit.zenoh_site import Site, wait_for

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
from agent.monitor import connections
from tests.unit.monitor_site import Served, many

IDLE = 1024
WITHIN_S = 0.2  # in place of the 10, 20 and 30 s


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    site = Site()
    with Served(site, tmp_path_factory.mktemp("monitor")) as server:
        yield server
    site.kill()


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HEADERS_S", "BODY_S", "SEND_S"):
        monkeypatch.setattr(connections, name, WITHIN_S)


def connected(served: Served) -> socket.socket:
    host, port = served.address.split(":")
    return socket.create_connection((host, int(port)), 10)


def is_readable(connection: socket.socket, timeout_s: float) -> bool:
    poll = select.poll()
    poll.register(connection, select.POLLIN)
    return bool(poll.poll(1000 * timeout_s))


def is_open(connection: socket.socket) -> bool:
    """Whether the server has not closed it. Reads what has come."""
    while is_readable(connection, 0.0):
        if not received(connection, 1 << 20):
            return False
    return True


def lived_s(connection: socket.socket, sent: Iterator[bytes], apart_s: float) -> float:
    """How long the server lets a client live that sends a piece each `apart_s`; a few seconds at most."""
    begun_s = time.monotonic()
    for piece in sent:
        try:
            connection.sendall(piece)
        except ConnectionError:
            break
        if is_readable(connection, apart_s):
            break
        assert time.monotonic() - begun_s < 9.0  # 10, 20 and 30 s are without `hasty`
    return time.monotonic() - begun_s


def test_idle_connections_do_not_take_the_page_away(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    logging.disable(logging.NOTSET)
    with many(served.address, IDLE) as idle:
        for _ in range(5):
            begun_s = time.monotonic()
            assert served.ask("/api/fleet").status == 200
            assert time.monotonic() - begun_s < 9.0  # an idle one is closed after 10 s
        wait_for(lambda: sum(map(is_open, idle)) <= connections.CONNECTIONS_MAX)
    told = [
        one.getMessage() for one in caplog.records if one.name in (connections.__name__, "asyncio", "uvicorn.error")
    ]
    assert len(told) == 1, told
    assert told[0].startswith("monitor: a connection was closed, because it was too slow")
    wait_for(lambda: served.ask("/api/fleet").status == 200)


@pytest.mark.usefixtures("hasty")
def test_slow_headers_and_bodies_end_in_time(served: Served) -> None:
    def trickle(head: bytes) -> Iterator[bytes]:
        yield head
        while True:
            yield b"x"

    host = f"Host: {served.address}\r\nOrigin: http://{served.address}\r\n".encode()
    whole = b"GET /api/me HTTP/1.1\r\n" + host + b"\r\n"
    heads = (b"", b"GET / HT", b"GET / HTTP/1.1\r\n" + host + b"X: ",
             b"POST /api/login HTTP/1.1\r\n" + host + b"Content-Length: 4000\r\n\r\n",
             b"POST /api/login HTTP/1.1\r\n" + host + b"Transfer-Encoding: chunked\r\n\r\nfff\r\n")  # fmt: skip
    for head in heads:
        with closing(connected(served)) as slow:
            assert lived_s(slow, trickle(head), 0.05) > WITHIN_S / 2, head
    with closing(connected(served)) as again:  # slow with its second request
        again.sendall(whole)
        answer = b""
        while not answer.endswith(b"}"):
            answer += again.recv(4096)
        assert answer.startswith(b"HTTP/1.1 200")
        assert lived_s(again, trickle(b"GET /"), 0.05) > WITHIN_S / 2


@pytest.mark.usefixtures("hasty")
def test_a_client_that_does_not_take_its_answer_ends_and_one_that_waits_for_changes_stays(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "SEND_BUFFER", 16 << 10)
    for number in range(4000):
        status = {"status": "VALID", "reason": "x" * 100, "t_utc_ns": 1}
        served.fleet.take("site", "gw", f"s{number}", "status", status)
    get = f"GET /api/{{}} HTTP/1.1\r\nHost: {served.address}\r\n\r\n"
    with closing(socket.socket()) as slow, closing(connected(served)) as patient:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.connect(patient.getpeername())
        patient.sendall(get.format("changes").encode())
        slow.sendall(get.format("fleet").encode())
        begun_s, taken = time.monotonic(), 0
        while data := received(slow, 1000):
            taken += len(data)
            assert time.monotonic() - begun_s < 19.0  # 20 s without `hasty`
            time.sleep(0.01)  # 100 kB/s, a piece in 0.6 s
        assert taken < len(served.ask("/api/fleet").text) / 2
        assert is_open(patient)
        assert served.ask("/api/fleet").text.endswith("}")


def received(connection: socket.socket, most: int) -> bytes:
    try:
        return connection.recv(most)
    except ConnectionError:
        return b""
