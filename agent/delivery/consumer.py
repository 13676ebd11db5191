"""The client library: receives every result of the chosen gateways once and in order, also after interruptions."""

from __future__ import annotations

import json
import queue
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Self

import zenoh
from zenoh.ext import HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from agent.config.tls import TlsFiles
from agent.delivery import memory as memory_file
from agent.delivery.answers import NOTHING, REMOVED
from agent.delivery.keys import PREFIX, narrow
from agent.delivery.received import Received, receive
from agent.delivery.session import session_config

INBOX = 1000  # samples that may wait or be held; further ones are dropped and later fetched from the gateway's store
ANSWER_S = 5.0  # s that one query waits for its answer
RETRY_S = 1.0  # s between two queries to a gateway whose results are held because an earlier one is missing
CONNECT_S = 10.0
SAVE_S = 1.0  # s between two writes of the memory file while results come without a pause; a pause writes it at once


__all__ = ["Consumer", "Received"]


class Consumer:
    """Receives the results under the key expression `key`, through the routers at `endpoints`.

    Iterating yields the results of each gateway in the order of their sequence, each once.
    `last_sequence`: the last result known of each gateway (`<site>/<gateway>`: number). Such a gateway begins with the
    results after that number, any other gateway with the values in force.
    `memory`: a file, made if it does not exist, in which the consumer keeps the last result that it has processed, so
    that it continues there after a restart. A result counts as processed when the next one is asked for. After a crash
    the results of its last second may come again, with the same numbers.

    Each result names the result published before it. Where this is not the last one known, results are missing: the
    consumer asks the gateway's store with `?after=` and holds later results until it answers. After a lost connection
    the newest results come again (history and recovery of Zenoh's advanced subscriber), so that a gap is seen at once.
    `close` may be called from another thread than the one that iterates.
    Raises EndpointError, ConnectionError or MemoryFileError; iterating raises OSError where `memory` cannot be written.
    """

    def __init__(
        self,
        endpoints: Sequence[str],
        key: str = f"{PREFIX}/**",
        last_sequence: Mapping[str, int] | None = None,
        memory: Path | None = None,
        *,
        tls: TlsFiles | None = None,
    ) -> None:
        self._memory = memory
        self._done = memory_file.load(memory) if memory is not None else {}
        self._saved_s = time.monotonic()
        self._saved = dict(self._done)
        self._told: dict[str, int] = {}  # by source: number up to which the user was told that results are removed
        self.last_sequence = self._done | dict(last_sequence or {})
        self._key = key
        self._inbox: queue.Queue[zenoh.Sample | None] = queue.Queue(maxsize=INBOX)  # None: the session is closed
        self._held: dict[str, deque[Received]] = {}
        self._mutex = threading.Lock()  # closing a session while another thread uses it raises an exception there
        self._closed = False
        config = session_config("client", connect=endpoints, tls=tls)
        config.insert_json5("connect/timeout_ms", json.dumps(int(CONNECT_S * 1000)))
        self._open = ExitStack()
        try:
            self._session = self._open.enter_context(zenoh.open(config))
        except zenoh.ZError:
            raise ConnectionError(f"no Zenoh router answers at {', '.join(endpoints)}") from None
        subscriber = declare_advanced_subscriber(
            self._session,
            key,
            zenoh.handlers.RingChannel(INBOX),
            history=HistoryConfig(detect_late_publishers=True),
            recovery=RecoveryConfig(heartbeat=True),  # type: ignore[call-arg]
        )
        self._open.callback(subscriber.undeclare)
        threading.Thread(target=self._take_samples, args=(subscriber,), name="consumer", daemon=True).start()

    def __iter__(self) -> Iterator[Received]:
        try:
            yield from self._results()
        finally:
            self._remember()

    def _results(self) -> Iterator[Received]:
        while True:
            if self._inbox.empty():
                self._remember()
            try:
                sample = self._inbox.get(timeout=RETRY_S if self._held else None)
            except queue.Empty:
                for source in list(self._held):
                    yield from self._ask(source)
                continue
            if sample is None:
                return
            if (result := _received(sample)) is not None:
                yield from self._follow(result)

    def close(self) -> None:
        """End the iteration and the session. May be called twice, from any thread."""
        with self._mutex:
            self._closed = True
            self._open.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take_samples(self, subscriber: Iterable[zenoh.Sample]) -> None:
        for sample in subscriber:
            self._inbox.put(sample)
        self._inbox.put(None)  # the subscriber is undeclared

    def _follow(self, result: Received) -> Iterator[Received]:
        source = result.address.source
        known = self.last_sequence.get(source)
        if known is not None and result.sequence <= known:
            return
        if known is not None and result.previous == known:
            yield from self._deliver(result)
            return
        self._held.setdefault(source, deque(maxlen=INBOX)).append(result)
        yield from self._ask(source)

    def _ask(self, source: str) -> Iterator[Received]:
        selector = narrow(self._key, source)
        known = self.last_sequence.get(source)
        while True:
            results, answered, removed = self._get(selector if known is None else f"{selector}?after={known}")
            if results and removed > self._told.get(source, 0):
                self._told[source] = removed
                results[0] = replace(results[0], removed_up_to=removed)
            yield from self._deliver(*results)
            if known is None or known == self.last_sequence[source]:
                break
            known = self.last_sequence[source]
        if answered:
            held = self._held.pop(source, ())
            yield from self._deliver(*sorted(held, key=lambda r: r.sequence))

    def _deliver(self, *results: Received) -> Iterator[Received]:
        for result in results:
            if result.sequence > self.last_sequence.get(result.address.source, -1):
                self.last_sequence[result.address.source] = result.sequence
                yield result
                self._done[result.address.source] = result.sequence
                if time.monotonic() - self._saved_s > SAVE_S:
                    self._remember()

    def _remember(self) -> None:
        if self._memory is not None and self._done != self._saved:
            memory_file.save(self._memory, self._done)
            self._saved, self._saved_s = dict(self._done), time.monotonic()

    def _get(self, selector: str) -> tuple[list[Received], bool, int]:
        """Query a gateway: (results in order, whether it answered, number up to which it has deleted results or 0)."""
        with self._mutex:
            if self._closed:
                return [], False, 0
            # With consolidation Zenoh would pass on only the last result of each key.
            replies = self._session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=ANSWER_S)
        answered, removed = False, 0
        results = []
        for reply in replies:
            if reply.ok:
                results.append(_received(reply.ok))
            gone = _removed(reply.err) if reply.err else 0
            removed = max(removed, gone)
            answered |= reply.err is None or gone > 0 or reply.err.payload.to_bytes() == NOTHING
        return sorted((r for r in results if r is not None), key=lambda r: r.sequence), answered, removed


def _removed(error: zenoh.ReplyError) -> int:
    """The number in an answer REMOVED; 0 for any other answer."""
    try:
        number = error.payload.to_string().removeprefix(REMOVED)
    except zenoh.ZError:
        return 0
    return int(number) if number.isascii() and number.isdigit() and len(number) < 19 else 0


def _received(sample: zenoh.Sample) -> Received | None:
    attachment = sample.attachment.to_bytes() if sample.attachment is not None else None
    return receive(str(sample.key_expr), sample.payload.to_bytes(), attachment)
