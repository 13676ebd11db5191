"""A router on loopback that can be killed and comes back at the same endpoint, and records to publish."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import msgspec
import zenoh

from agent.core.events import Result
from agent.delivery.consumer import Consumer, Received
from agent.delivery.history import StoredResult
from agent.delivery.router import open_router
from agent.delivery.session import session_config
from tests.unit.results import calibration, clock, status, window

KEY = "fieldcal/v1/site/gw"


def router_process(*options: str) -> subprocess.Popen[str]:
    """`fieldcal router` in a process of its own."""
    command = [sys.executable, "-m", "agent", "router", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


class Site:
    """The router of a test."""

    def __init__(self) -> None:
        self._router, (self.endpoint,) = open_router("tcp/127.0.0.1:0")

    def kill(self) -> None:
        """The router is gone."""
        self._router.close()

    def restart(self) -> None:
        """A new router at the same endpoint."""
        self._router, _ = open_router(self.endpoint)

    def client(self) -> zenoh.Session:
        """A plain client session."""
        return zenoh.open(session_config("client", connect=[self.endpoint]))


def record(sequence: int, what: str = "window", sensor: str = "mems", **fields: Any) -> StoredResult:
    """A result; `fields` are added to its payload."""
    makers: dict[str, Callable[[int], Result]]
    makers = {"window": window, "calibration": calibration, "status": status, "clock": clock}
    whole = makers[what](sequence)
    payload = {**msgspec.structs.asdict(whole), "sensor": sensor, "recorded": True, **fields}
    return StoredResult(sequence, "run-1", sensor, what, msgspec.json.encode(payload), 1000 + sequence, True, "f.mcap")


def sequence_of(sample: zenoh.Sample) -> int:
    """The number in a sample's payload."""
    number = msgspec.json.decode(sample.payload.to_bytes())["sequence"]
    assert isinstance(number, int)
    return number


def wait_for(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    """Until the condition holds; an AssertionError after `timeout_s`."""
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"{condition} did not come true within {timeout_s} s"
        time.sleep(0.01)  # polls; the condition decides, not the time


def taken_until(consumer: Consumer, done: Callable[[Received], bool], timeout_s: float = 60.0) -> list[Received]:
    """The results up to the first for which `done` holds; those that came within `timeout_s` where it never does."""
    timer = threading.Timer(timeout_s, consumer.close)
    timer.start()
    taken: list[Received] = []
    results = iter(consumer)
    for result in results:
        taken.append(result)
        if done(result):
            break
    results.close()  # type: ignore[attr-defined]
    timer.cancel()
    return taken
