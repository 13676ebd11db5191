"""Follows the gateways on the bus: their results into the database, and whether they are there."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import zenoh

from agent.config.key_file import KeyFileError
from agent.config.known_keys import WatchedKeys
from agent.config.tls import TlsFiles
from agent.delivery.consumer import Consumer
from agent.delivery.guide import WHAT, read_guide
from agent.delivery.hearing import Hearing
from agent.delivery.keys import PREFIX, parse_key
from agent.delivery.session import session_config
from agent.delivery.verifying import Refusals, UnverifiedError
from agent.monitor.benches import Benches
from agent.monitor.database import Database
from agent.monitor.fleet import Fleet

RECONNECT_S = 2.0  # s between two attempts to reach a router
CLOSE_S = 2.0
LOOK_S = 1.0  # s between two looks whether the router still hears
# Results in one transaction at most: what PostgreSQL takes for one is shared, and SQLite delays no question for long.
BATCH = 100
TOKENS = 10_000  # changes of presence that may wait
GUIDES = 100  # messages of benches that may wait; each one says all

_log = logging.getLogger(__name__)


class Following:
    """Takes all results from the routers at `endpoints`, in threads, until `close`.

    `unconfirmed` counts results that were not kept, because the store of their gateway did not have them. `benches`:
    the guides of `fieldcal bench`.
    `keys`: the list of known keys; results and guides that their gateway did not sign are then refused.
    Raises EndpointError for an invalid endpoint.
    """

    def __init__(
        self, endpoints: Sequence[str], tls: TlsFiles | None, database: Database, fleet: Fleet, keys: Path | None = None
    ) -> None:
        self.unconfirmed = 0
        self.keys = keys
        self.benches = Benches()
        self._known = WatchedKeys(keys) if keys is not None else None
        self._refused_guides = Refusals()
        self._consumer: Consumer | None = None
        self.fault = ""  # why nothing is received or kept; "" where all is well
        self._endpoints, self._tls = endpoints, tls
        self._config = session_config("client", connect=endpoints, tls=tls)
        self._database, self._fleet = database, fleet
        self._stop = threading.Event()
        self._hearing = Hearing()  # of the session for presence and health; the consumer looks after its own
        self._open = ExitStack()
        for place in database.newest():
            fleet.take(*place, fresh=False)
        self._thread = threading.Thread(target=self._run, name="following", daemon=True)
        self._thread.start()

    @property
    def refused(self) -> dict[str, int]:
        """The number of messages that were not verified, by the gateway in whose name they were published."""
        results = Counter(self._consumer.refused if self._consumer is not None else {})
        return results + self._refused_guides.counts

    def close(self, timeout_s: float = CLOSE_S) -> bool:
        """End the threads. May be called twice.

        Returns False where a router that does not answer still blocks a thread after `timeout_s`.
        """
        self._stop.set()
        self._open.close()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._follow()
            except (ConnectionError, KeyFileError, zenoh.ZError, sqlite3.Error) as error:
                self.fault = str(error)
                _log.warning("monitor: %s", error)
            self._stop.wait(RECONNECT_S)

    def _follow(self) -> None:
        last = self._database.last_sequence()
        consumer = self._consumer = Consumer(self._endpoints, last_sequence=last, tls=self._tls, keys=self.keys)
        with consumer, zenoh.open(self._config) as session:
            self._open.callback(consumer.close)
            if self._stop.is_set():  # `close` may have been before the callback
                return
            tokens = session.liveliness().declare_subscriber(
                f"{PREFIX}/*/*/alive", zenoh.handlers.FifoChannel(TOKENS), history=True
            )
            told = session.declare_subscriber(f"{PREFIX}/*/*/status", zenoh.handlers.RingChannel(TOKENS))
            guides = session.declare_subscriber(f"{PREFIX}/*/*/{WHAT}", zenoh.handlers.RingChannel(GUIDES))
            self._hearing.begin(session)
            ended = threading.Event()
            threads = [
                threading.Thread(target=self._watch, args=(tokens,), name="presence", daemon=True),
                threading.Thread(target=self._hear, args=(told,), name="health", daemon=True),
                threading.Thread(target=self._read, args=(guides,), name="guides", daemon=True),
                threading.Thread(target=self._look, args=(consumer, ended), name="look", daemon=True),
            ]
            for thread in threads:
                thread.start()
            self.fault = ""
            try:
                self._take(consumer)
            finally:
                ended.set()
                tokens.undeclare()
                told.undeclare()
                guides.undeclare()
                for thread in threads:
                    thread.join(CLOSE_S)

    def _take(self, consumer: Consumer) -> None:
        for batch in consumer.batches(BATCH):
            confirmed = [result for result in batch if result.confirmed]
            self.unconfirmed += len(batch) - len(confirmed)
            shown = [result for result in confirmed if self._fleet.admits(result.address)]
            for result in shown:
                result.fields["signed_by"] = result.signed_by
            if shown:
                self._database.add(shown)
            for result in shown:
                a = result.address
                self._fleet.take(a.site, a.gateway, a.sensor, a.what, result.fields)

    def _look(self, consumer: Consumer, ended: threading.Event) -> None:
        while not ended.wait(LOOK_S):
            if self._hearing.lost():
                consumer.close()  # then both sessions are opened anew
                return

    def _watch(self, tokens: zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]) -> None:
        for token in tokens:
            if (address := parse_key(str(token.key_expr))) is not None:
                self._fleet.set_alive(address.site, address.gateway, token.kind == zenoh.SampleKind.PUT)

    def _hear(self, told: zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]) -> None:
        for sample in told:
            if (address := parse_key(str(sample.key_expr))) is not None:
                self._fleet.set_told(address.site, address.gateway, sample.payload.to_bytes())

    def _read(self, guides: zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]) -> None:
        for sample in guides:
            if (address := parse_key(str(sample.key_expr))) is None:
                continue
            signed = sample.attachment.to_bytes() if sample.attachment is not None else b""
            try:
                guide = read_guide(sample.payload.to_bytes(), signed, address.source, self._known)
            except UnverifiedError as error:
                self._refused_guides.count(address.source, str(error))
                continue
            if guide is not None:
                self.benches.take(address.site, address.gateway, guide)
