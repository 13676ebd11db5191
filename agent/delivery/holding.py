"""Results that a consumer holds because earlier ones may be missing, and when it asks their gateways for those.

A stranger may publish results of gateways that do not exist, or with numbers far ahead, as fast as the network allows.
So a gateway is asked at most once in RETRY_S, results wait for a bounded time, and both gateways and results that wait
are bounded in number. What is dropped is counted. AT_ONCE gateways are asked at the same time. Those that did not
answer the last time, or are not known yet, are half of them at most, so that they never keep the others waiting.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass, field
from heapq import heappop, heappush

from agent.delivery.received import Received
from agent.delivery.seldom import Seldom

AT_ONCE = 32  # gateways that are asked at the same time
RESULTS_MAX = 500  # of a gateway that are held; further ones push out the oldest, which are in the gateway's store
GATEWAYS_MAX = 2000  # of which results are held
LOOKS_MAX = 2 * AT_ONCE  # gateways that wait to be asked although nothing of them is held
RETRY_S = 1.0  # s between two queries to a gateway
RETRY_LONGEST_S = 30.0  # s between two queries to a gateway that never answered; from RETRY_S each takes twice as long
GIVE_UP_S = 300.0  # s without an answer, after which results are given although earlier ones may be missing


@dataclass
class _WaitingResult:
    answers: bool  # it answered the last time, or results of it are known
    due_s: float  # monotonic time from which the gateway may be asked (again)
    results: deque[Received] = field(default_factory=lambda: deque(maxlen=RESULTS_MAX))
    later: deque[Received] = field(default_factory=lambda: deque(maxlen=RESULTS_MAX))  # came while it was being asked
    look: bool = False  # it is to be asked also where nothing is held
    wait_s: float = RETRY_S
    silent_since_s: float | None = None  # time of the first query that was not answered


class WaitingResults:
    """The results that wait, by gateway (`<site>/<gateway>`). `dropped`: how many were not kept, by gateway."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self._waiting: dict[str, _WaitingResult] = {}
        self._asking: dict[str, bool] = {}  # the gateways that are being asked, and whether they answered the last time
        # All others that wait, by the time from which they may be asked, apart by whether they answered the last time.
        self._next: dict[bool, list[tuple[float, str]]] = {True: [], False: []}
        self._looks = 0  # that wait
        self._log = Seldom()

    def add(self, result: Received, *, known: bool = False) -> None:
        """Hold a result; where there is no place for it, it is dropped and counted. `known`: its gateway is known."""
        source = result.address.source
        if source not in self._waiting and len(self._waiting) >= GATEWAYS_MAX:
            self._drop("", f"results of {GATEWAYS_MAX} gateways are held already")
            return
        waiting = self._of(source, known)
        self._hold(result, waiting.later if source in self._asking else waiting.results)

    def look(self, source: str, *, known: bool) -> None:
        """Ask a gateway although nothing of it is held. Only while there is `room`."""
        waiting = self._of(source, known)
        self._looks += not waiting.look
        waiting.look = True

    def room(self) -> int:
        """The number of gateways for which `look` may be called now."""
        return LOOKS_MAX - self._looks

    def _of(self, source: str, known: bool) -> _WaitingResult:
        if source not in self._waiting:
            self._waiting[source] = _WaitingResult(known, time.monotonic())
            self._queue(source)
        return self._waiting[source]

    def _hold(self, result: Received, among: deque[Received]) -> None:
        if len(among) == RESULTS_MAX:
            self._drop(result.address.source, f"it does not answer, and {RESULTS_MAX} results are held already")
        among.append(result)

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

    def pop_later(self, source: str) -> list[Received]:
        """Take what came of a gateway while it was being asked, in the order of coming."""
        if (waiting := self._waiting.get(source)) is None:
            return []
        came, waiting.later = list(waiting.later), deque(maxlen=RESULTS_MAX)
        return came

    def wait_s(self) -> float | None:
        """Time in s until `due` has something to do; None where nothing waits, or others must be answered before."""
        due_s = [queue[0][0] for queue in self._open_queues()]
        return max(0.0, min(due_s) - time.monotonic()) if due_s else None

    def due(self) -> list[str]:
        """The gateways to ask now; each is being asked until `ended`."""
        now_s, found = time.monotonic(), []
        while queues := [queue for queue in self._open_queues() if queue[0][0] <= now_s]:
            source = heappop(min(queues))[1]
            waiting = self._waiting[source]
            if waiting.results or waiting.later or waiting.look:
                self._asking[source] = waiting.answers
                self._looks -= waiting.look
                waiting.look = False
                found.append(source)
            else:
                del self._waiting[source]
        return found

    def _open_queues(self) -> list[list[tuple[float, str]]]:
        """The queues of which the first gateway may be asked beside those that are."""
        if len(self._asking) >= AT_ONCE:
            return []
        doubted = sum(not answers for answers in self._asking.values())
        return [queue for answers, queue in self._next.items() if queue and (answers or doubted < AT_ONCE // 2)]

    def _queue(self, source: str) -> None:
        waiting = self._waiting[source]
        heappush(self._next[waiting.answers], (waiting.due_s, source))

    def ended(self, source: str) -> None:
        """A gateway is not being asked any more."""
        if self._asking.pop(source, None) is not None:
            self._queue(source)

    def asked(self, source: str, *, answered: bool, known: bool) -> bool:
        """A gateway was asked. Returns whether its results are to be given now, since no earlier ones will come.

        `known`: it answered at some time, so it is asked as often as allowed.
        """
        if (waiting := self._waiting.get(source)) is None:
            return answered
        now_s = time.monotonic()
        waiting.wait_s = RETRY_S if known or answered else min(2 * waiting.wait_s, RETRY_LONGEST_S)
        waiting.due_s = now_s + waiting.wait_s
        waiting.answers = answered
        if answered:
            waiting.silent_since_s = None
            return True
        if waiting.silent_since_s is None and waiting.results:
            waiting.silent_since_s = now_s
            told = "%s does not answer: its results are held, for %g s at most, because earlier ones may be missing"
            self._log.warning(told, source, GIVE_UP_S)
        return waiting.silent_since_s is not None and now_s - waiting.silent_since_s > GIVE_UP_S
