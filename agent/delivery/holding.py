"""Results that a consumer holds because earlier ones may be missing, and when it asks their gateways for those.

A stranger may publish results of gateways that do not exist, or with numbers far ahead, as fast as the network allows.
So a gateway is asked at most once in RETRY_S, results wait for a bounded time, and both gateways and results that wait
are bounded in number. What is dropped is counted.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass, field

from agent.delivery.received import Received
from agent.delivery.seldom import Seldom

RESULTS_MAX = 1000  # of a gateway that are held; further ones push out the oldest, which are in the gateway's store
GATEWAYS_MAX = 1000  # of which results are held
RETRY_S = 1.0  # s between two queries to a gateway
RETRY_LONGEST_S = 30.0  # s between two queries to a gateway that never answered; from RETRY_S each takes twice as long
GIVE_UP_S = 300.0  # s without an answer, after which results are given although earlier ones may be missing


@dataclass
class _Waiting:
    results: deque[Received] = field(default_factory=lambda: deque(maxlen=RESULTS_MAX))
    due_s: float = 0.0  # monotonic time from which the gateway may be asked (again)
    wait_s: float = RETRY_S
    silent_since_s: float | None = None  # time of the first query that was not answered


class Held:
    """The results that wait, by gateway (`<site>/<gateway>`). `dropped`: how many were not kept, by gateway."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self._waiting: dict[str, _Waiting] = {}
        self._log = Seldom()

    def add(self, result: Received) -> None:
        """Hold a result; where there is no place for it, it is dropped and counted."""
        source = result.address.source
        if source not in self._waiting and len(self._waiting) >= GATEWAYS_MAX:
            self._drop("", f"results of {GATEWAYS_MAX} gateways are held already")
            return
        waiting = self._waiting.setdefault(source, _Waiting())
        if len(waiting.results) == RESULTS_MAX:
            self._drop(source, f"it does not answer, and {RESULTS_MAX} results are held already")
        waiting.results.append(result)

    def _drop(self, source: str, reason: str) -> None:
        self.dropped[source] += 1
        self._log.warning("a result of %s is dropped: %s (%d so far)", source or "-", reason, self.dropped.total())

    def of(self, source: str) -> tuple[Received, ...]:
        """What is held of a gateway."""
        return tuple(self._waiting[source].results) if source in self._waiting else ()

    def pop(self, source: str) -> list[Received]:
        """Take what is held of a gateway, in the order of the numbers."""
        results = sorted(self.of(source), key=lambda result: result.sequence)
        if source in self._waiting:
            self._waiting[source].results.clear()
        return results

    def wait_s(self) -> float | None:
        """Time in s until a gateway may be asked; None where nothing is held."""
        due = [waiting.due_s for waiting in self._waiting.values() if waiting.results]
        return max(0.0, min(due) - time.monotonic()) if due else None

    def due(self) -> list[str]:
        """The gateways to ask now."""
        now_s = time.monotonic()
        passed = {source for source, waiting in self._waiting.items() if waiting.due_s <= now_s}
        for source in [source for source in passed if not self._waiting[source].results]:
            del self._waiting[source]
        return [source for source in self._waiting if source in passed]

    def asked(self, source: str, *, answered: bool, known: bool) -> bool:
        """A gateway was asked. Returns whether its results are to be given now, since no earlier ones will come.

        `known`: it answered at some time, so it is asked as often as allowed.
        """
        if (waiting := self._waiting.get(source)) is None:
            return answered
        now_s = time.monotonic()
        waiting.wait_s = RETRY_S if known or answered else min(2 * waiting.wait_s, RETRY_LONGEST_S)
        waiting.due_s = now_s + waiting.wait_s
        if answered:
            waiting.silent_since_s = None
            return True
        if waiting.silent_since_s is None:
            waiting.silent_since_s = now_s
            told = "%s does not answer: its results are held, for %g s at most, because earlier ones may be missing"
            self._log.warning(told, source, GIVE_UP_S)
        return now_s - waiting.silent_since_s > GIVE_UP_S
