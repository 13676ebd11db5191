"""The client library: every result of the gateways one follows, each once and in order, over any interruption."""

from __future__ import annotations

import json
import queue
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Self

import msgspec
import zenoh
from zenoh.ext import HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from agent.answers import NOTHING
from agent.keys import PREFIX, Address, narrow, parse_key
from agent.session import session_config

INBOX = 1000  # samples that may wait, or be held; what is dropped is fetched from the gateway's store
ANSWER_S = 5.0  # for one query
RETRY_S = 1.0  # between questions to a gateway whose results are held because something before them is missing
CONNECT_S = 10.0


@dataclass(frozen=True, slots=True)
class Received:
    """One result. `fields` is its JSON: the fields of agent.events, and `recorded`."""

    key: str
    address: Address
    sequence: int
    fields: dict[str, Any]
    previous: int | None  # the result that the gateway put before this one; None in an answer to a query


class Consumer:
    """Follows the results under `key` through the routers at `endpoints`.

    Iterating yields the results of each gateway in the order of their sequence, each once. A gateway met for the first
    time begins with the values in force; one named in `last_sequence` (`<site>/<gateway>`: number) with all that came
    after. Whenever a number is missing, and after every reconnection, the gateway's store is asked with `?after=`;
    until it answers, what came later is held.
    `close` may be called from another thread than the one that iterates.
    Raises EndpointError or ConnectionError.
    """

    def __init__(
        self, endpoints: Sequence[str], key: str = f"{PREFIX}/**", last_sequence: Mapping[str, int] | None = None
    ) -> None:
        self.last_sequence = dict(last_sequence or {})
        self._key = key
        # None: the router is back, ask everyone; a second None ends the iteration once `close` was called.
        self._inbox: queue.Queue[zenoh.Sample | None] = queue.Queue(maxsize=INBOX)
        self._held: dict[str, deque[Received]] = {}
        self._closed = threading.Event()
        config = session_config("client", connect=endpoints)
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
        links = self._session.info.declare_transport_events_listener(zenoh.handlers.RingChannel(16), history=True)
        self._open.callback(links.undeclare)
        for target, source in ((self._take_samples, subscriber), (self._take_links, links)):
            threading.Thread(target=target, args=(source,), name="consumer", daemon=True).start()

    def __iter__(self) -> Iterator[Received]:
        while True:
            try:
                sample = self._inbox.get(timeout=RETRY_S if self._held else None)
            except queue.Empty:
                for source in list(self._held):
                    yield from self._ask(source)
                continue
            if self._closed.is_set():
                return
            if sample is None:
                yield from self._ask_everyone()
            elif (result := _received(sample)) is not None:
                yield from self._follow(result)

    def close(self) -> None:
        """End the iteration and the session. May be called twice, from any thread."""
        if not self._closed.is_set():
            self._closed.set()
            self._open.close()
            try:
                self._inbox.put_nowait(None)
            except queue.Full:
                return  # the iteration is not waiting then

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take_samples(self, subscriber: Iterable[zenoh.Sample]) -> None:
        for sample in subscriber:
            self._inbox.put(sample)

    def _take_links(self, links: Iterable[zenoh.TransportEvent]) -> None:
        for link in links:
            if link.kind == zenoh.SampleKind.PUT:
                self._inbox.put(None)

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

    def _ask_everyone(self) -> Iterator[Received]:
        # A gateway that was never met and has nothing new to say would stay unknown.
        met = {result.address.source for result in self._get(self._key)[0]}
        for source in sorted(met | self.last_sequence.keys()):
            yield from self._ask(source)

    def _ask(self, source: str) -> Iterator[Received]:
        selector = narrow(self._key, source)
        known = self.last_sequence.get(source)
        while True:
            results, answered = self._get(selector if known is None else f"{selector}?after={known}")
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

    def _get(self, selector: str) -> tuple[list[Received], bool]:
        """The results in order, and whether anybody answered at all."""
        answered = False
        results = []
        try:
            # Without consolidation, else only the last result of each key would come.
            for reply in self._session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=ANSWER_S):
                if reply.ok:
                    results.append(_received(reply.ok))
                answered |= reply.err is None or reply.err.payload.to_bytes() == NOTHING
        except zenoh.ZError:
            pass  # the session was closed meanwhile
        return sorted((r for r in results if r is not None), key=lambda r: r.sequence), answered


def _received(sample: zenoh.Sample) -> Received | None:
    """None for what is no result of ours: others may put what they like on the same keys."""
    address = parse_key(str(sample.key_expr))
    try:
        fields = msgspec.json.decode(sample.payload.to_bytes(), type=dict[str, Any])
        previous = int(sample.attachment.to_string()) if sample.attachment else None
    except (msgspec.DecodeError, ValueError, zenoh.ZError):
        return None
    sequence = fields.get("sequence")
    if address is None or not isinstance(sequence, int):
        return None
    return Received(str(sample.key_expr), address, sequence, fields, previous)
