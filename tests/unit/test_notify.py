"""Notifications as systemd would receive them, over real datagram sockets."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.supervision.notify import STATUS_MAX, SystemdNotifier


class Receiver:
    """systemd's end."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self._socket.setblocking(False)

    def told(self) -> list[str]:
        messages = []
        while True:
            try:
                messages.append(self._socket.recv(4096).decode())
            except BlockingIOError:
                return messages

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["path", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Receiver]:
    receiver = Receiver(str(tmp_path / "notify") if request.param == "path" else f"@fieldcal-test-{os.getpid()}")
    yield receiver
    receiver.close()


def test_what_is_said_arrives(systemd: Receiver) -> None:
    notifier = SystemdNotifier({"NOTIFY_SOCKET": systemd.address})
    assert notifier.ready()
    notifier.status("running: all\nis well")
    notifier.status("running: all\nis well")
    notifier.status("x" * 10_000)
    notifier.stopping()
    notifier.close()
    assert systemd.told() == ["READY=1", "STATUS=running: all is well", "STATUS=" + "x" * STATUS_MAX, "STOPPING=1"]


def test_the_watchdog_is_fed_as_often_as_it_needs_and_only_when_fed(
    systemd: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = iter(range(24))  # of 1/64 s
    monkeypatch.setattr(time, "monotonic", lambda: 100.0 + next(steps) / 64.0)
    notifier = SystemdNotifier(
        {"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "400000", "WATCHDOG_PID": str(os.getpid())}
    )
    assert notifier.watchdog_s == pytest.approx(0.4)
    for _ in range(24):
        notifier.feed()
    assert systemd.told() == ["WATCHDOG=1"] * 4  # at once, and in the first step that is 0.1 s later
    notifier.ready()
    assert systemd.told() == ["READY=1"], "nothing but `feed` feeds it"
    notifier.close()


@pytest.mark.parametrize(
    "environment",
    [{}, {"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "soon"}, {"WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}],
)
def test_without_a_watchdog_of_ours_nothing_is_fed(systemd: Receiver, environment: dict[str, str]) -> None:
    notifier = SystemdNotifier(environment | {"NOTIFY_SOCKET": systemd.address})
    notifier.feed()
    assert systemd.told() == []
    notifier.close()


@pytest.mark.parametrize("address", ["", "relative/path", "vsock:2:1234", "/nobody/is/there"])
def test_without_systemd_nothing_fails(address: str) -> None:
    notifier = SystemdNotifier({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "1000"} if address else {})
    notifier.status("running")
    notifier.feed()
    notifier.stopping()
    assert notifier.ready() is not address.startswith("/"), "what could not be said must be said again"
    notifier.close()


def test_a_full_queue_does_not_block_and_ready_is_not_lost(systemd: Receiver) -> None:
    notifier = SystemdNotifier({"NOTIFY_SOCKET": systemd.address})
    for n in range(100):
        notifier.status(f"{n}")
    assert not notifier.ready()
    told = systemd.told()
    assert 1 <= len(told) < 100
    assert notifier.ready()
    assert systemd.told() == ["READY=1"]
    notifier.close()


def test_a_child_process_is_not_this_service(systemd: Receiver) -> None:
    environment = {"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "1000000", "HOME": "/"}
    SystemdNotifier(environment).close()
    assert environment == {"HOME": "/"}
