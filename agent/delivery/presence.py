"""Which gateways are on the bus, and when a consumer asks each of them for results of which nothing tells it.

A result of which the sample is lost is noticed at the next one of its gateway. But there may be none for a long time.
So a gateway is asked when it appears, also after a lost connection, and then about once in LOOK_S.
"""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from heapq import heappop, heappush

import zenoh

from agent.delivery.keys import parse_key, presence_key

LOOK_S = 60.0  # s between two looks at a gateway, half as much at least and once more as much at most
GATEWAYS_MAX = 10_000  # that are looked at; a stranger may declare the tokens of gateways that do not exist


class Presence:
    """The gateways under the key expression `key` that have a liveliness token. `wake` is called when there is news.

    Tokens come in a thread of Zenoh, which only notes them here. All else is for one thread. The subscription ends with
    `close`, before the session does.
    """

    def __init__(self, session: zenoh.Session, key: str, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._mutex = threading.Lock()
        self._news: dict[str, bool] = {}  # by source: whether it has a token now
        self._looks: list[tuple[float, str]] = []  # heap of (monotonic time of the next look, source)
        self._look_s: dict[str, float] = {}  # the same, of each gateway that is there
        handler = zenoh.handlers.Callback(self._hear, indirect=False)
        self._subscriber = session.liveliness().declare_subscriber(presence_key(key), handler, history=True)

    def close(self) -> None:
        """End the subscription."""
        self._subscriber.undeclare()

    def due(self, most: int) -> list[str]:
        """At most so many gateways to look at now."""
        now_s = time.monotonic()
        with self._mutex:
            news, self._news = self._news, {}
        for source, there in news.items():
            if not there:
                self._look_s.pop(source, None)
            elif source in self._look_s or len(self._look_s) < GATEWAYS_MAX:
                self._plan(source, now_s)
        found: list[str] = []
        while len(found) < most and self._looks and self._looks[0][0] <= now_s:
            at_s, source = heappop(self._looks)
            if self._look_s.get(source) == at_s:
                found.append(source)
                self._plan(source, now_s + LOOK_S * random.uniform(0.5, 1.5))
        return found

    def wait_s(self) -> float | None:
        """Time in s until `due` finds a gateway, unless news comes; None where there is none."""
        return max(0.0, self._looks[0][0] - time.monotonic()) if self._looks else None

    def _plan(self, source: str, at_s: float) -> None:
        self._look_s[source] = at_s
        heappush(self._looks, (at_s, source))
        if len(self._looks) > 2 * GATEWAYS_MAX:  # plans of gateways that have gone, or come again
            self._looks = sorted((s, name) for name, s in self._look_s.items())

    def _hear(self, token: zenoh.Sample) -> None:
        if (address := parse_key(str(token.key_expr))) is None:
            return
        with self._mutex:
            first = not self._news
            if address.source in self._news or len(self._news) < GATEWAYS_MAX:
                self._news[address.source] = token.kind == zenoh.SampleKind.PUT
        if first:
            self._wake()
