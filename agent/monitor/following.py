"""Follows the gateways on the bus: their results into the database, and whether they are there."""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import zenoh

from agent.config.key_file import KeyFileError
from agent.config.known_keys import WatchedKeys
from agent.config.tls import TlsFiles
from agent.delivery.consumer import Consumer
from agent.delivery.guide import WHAT, read_guide
from agent.delivery.hearing import Hearing
from agent.delivery.keys import PREFIX, parse_key
from agent.delivery.received import Received
from agent.delivery.seldom import Seldom
from agent.delivery.session import closed_in_time, session_config
from agent.delivery.verifying import Refusals, UnverifiedError
from agent.monitor.benches import Benches
from agent.monitor.database import Database
from agent.monitor.engines import DatabaseError
from agent.monitor.fleet import Fleet, Place

RECONNECT_S = 2.0  # s between two attempts to reach a router
AGAIN_S = 1.0  # s between two attempts to write to a database that cannot be written
CLOSE_S = 1.0  # s to wait for a thread; what it has not kept by then is fetched again from the gateways
LOOK_S = 1.0  # s between two looks whether the router still hears
LOG_S = 60.0  # s between two lines of the log about the same thing
# Results in one transaction at most: what PostgreSQL takes for one is shared, and SQLite delays no question for long.
BATCH = 100
VERDICTS = 200  # on one sensor, the newest, that are looked at after a restart
TOKENS = 10_000  # changes of presence that may wait
GUIDES = 100  # messages of benches that may wait; each one says all
# What SQLite says of a result; all its other errors are of the file, the disk, or another program that has locked it.
_OF_THE_RESULT = (sqlite3.DataError, sqlite3.IntegrityError, sqlite3.InterfaceError, sqlite3.ProgrammingError)

_log = logging.getLogger(__name__)


class Following:
    """Takes all results from the routers at `endpoints`, in threads, until `close`.

    `unconfirmed` counts results that were not kept, because the store of their gateway did not have them. `faults`
    counts results and messages that a fault of this program has cost; the threads go on with the next one. While the
    database cannot be written results wait; those for which there is no room are then fetched from their gateways.
    `benches`: the guides of `fieldcal bench`.
    `keys`: the list of known keys; results and guides that their gateway did not sign are then refused.
    Raises EndpointError for an invalid endpoint.
    """

    def __init__(
        self, endpoints: Sequence[str], tls: TlsFiles | None, database: Database, fleet: Fleet, keys: Path | None = None
    ) -> None:
        self.unconfirmed = self.faults = 0
        self.keys = keys
        self.benches = Benches()
        self._known = WatchedKeys(keys) if keys is not None else None
        self._refused_guides = Refusals()
        self._consumer: Consumer | None = None
        self._not_received = self._not_kept = ""  # why nothing is received, or kept; "" where all is well
        self._kept_s: float | None = None  # monotonic time of the last result that was kept
        self._told_outage, self._told_fault = Seldom(_log, LOG_S), Seldom(_log, LOG_S)
        self._endpoints, self._tls = endpoints, tls
        self._config = session_config("client", connect=endpoints, tls=tls)
        self._database, self._fleet = database, fleet
        self._stop = threading.Event()
        self._hearing = Hearing()  # of the session for presence and health; the consumer looks after its own
        self._open = ExitStack()
        newest = database.newest()
        changed = {
            (site, gateway, sensor)
            for site, gateway, sensor, what, fields in newest
            if what == "drift" and fields.get("verdict") in ("drifting", "stepped")
        }

        def recall(place: Place) -> None:
            fleet.recall(place, database.history(*place, "drift", VERDICTS))

        self._take_each(sorted(changed), recall)
        self._take_each(newest, lambda place: fleet.take(*place, fresh=False))
        self._thread = threading.Thread(target=self._run, name="following", daemon=True)
        self._thread.start()

    @property
    def refused(self) -> dict[str, int]:
        """The number of messages that were not verified, by the gateway in whose name they were published."""
        results = Counter(self._consumer.refused if self._consumer is not None else {})
        return results + self._refused_guides.counts

    def state(self) -> dict[str, Any]:
        """How the following goes, for the page.

        `fault`: why nothing is received or kept, and what was left out, in words; "" where all is well. `malformed`:
        messages in the place of a result that are none. `last_result_age_s`: time in s since a result was kept; None
        where none was since the start.
        """
        malformed = sum(self._consumer.malformed.values()) if self._consumer is not None else 0
        damaged = self._database.damaged
        ended = not (self._thread.is_alive() or self._stop.is_set())
        age_s = None if self._kept_s is None else time.monotonic() - self._kept_s
        told = {
            "the bus is not followed any more: start the monitor again": ended,
            self._not_received: self._not_received,
            f"results are not kept, and wait: {self._not_kept}": self._not_kept,
            f"{malformed} malformed messages in the place of results were left out": malformed,
            f"{len(damaged)} damaged results of the database were left out": damaged,
            f"{self.faults} results or messages were left out by a fault of this program (see its log)": self.faults,
        }
        words = [text for text, holds in told.items() if holds]
        if words and age_s is not None:
            words.append(f"the last good result came {age_s:.0f} s ago")
        return {"fault": "; ".join(words), "faults": self.faults, "malformed": malformed,
                "unconfirmed": self.unconfirmed, "last_result_age_s": age_s}  # fmt: skip

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
                self._not_received = str(error)
                self._told_outage.warning("monitor: %s", error)
            except Exception as error:
                self._count_fault(error)
            self._stop.wait(RECONNECT_S)

    def _take_each(self, things: Iterable[Any], take: Callable[[Any], object]) -> None:
        """Take things one by one; one that cannot be taken is counted, and the next one is taken."""
        for thing in things:
            try:
                take(thing)
            except Exception as error:
                self._count_fault(error)

    def _count_fault(self, error: Exception) -> None:
        self.faults += 1
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}:{place.lineno}"
        what = "monitor: a fault of this program, please report it: %s in %s: %.200s (%d so far)"
        self._told_fault.warning(what, type(error).__name__, where, error, self.faults)

    def _follow(self) -> None:
        last = self._database.last_sequence()
        consumer = self._consumer = Consumer(self._endpoints, last_sequence=last, tls=self._tls, keys=self.keys)
        with consumer, closed_in_time(zenoh.open(self._config)) as session:
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
                threading.Thread(target=self._take_each, args=(tokens, self._take_token), name="presence", daemon=True),
                threading.Thread(target=self._take_each, args=(told, self._take_status), name="health", daemon=True),
                threading.Thread(target=self._take_each, args=(guides, self._take_guide), name="guides", daemon=True),
                threading.Thread(target=self._look, args=(consumer, session, ended), name="look", daemon=True),
            ]
            for thread in threads:
                thread.start()
            self._not_received = ""
            try:
                self._take_each(consumer.batches(BATCH), self._take)
            finally:
                ended.set()
                tokens.undeclare()
                told.undeclare()
                guides.undeclare()
                for thread in threads:
                    thread.join(CLOSE_S)

    def _take(self, batch: Sequence[Received]) -> None:
        confirmed = [result for result in batch if result.confirmed]
        self.unconfirmed += len(batch) - len(confirmed)
        shown = [result for result in confirmed if self._fleet.admits(result.address)]
        for result in shown:
            result.fields["signed_by"] = result.signed_by
        self._take_each(self._keep(shown), self._show)

    def _keep(self, results: Sequence[Received]) -> Sequence[Received]:
        """Add results to the database, as soon as it can be written; returns those that it has taken."""
        while results and not self._stop.is_set():
            try:
                self._database.add(results)
            except (sqlite3.Error, DatabaseError) as error:
                if isinstance(error, _OF_THE_RESULT):
                    return self._keep_singly(results, error)
                self._not_kept = str(error)
                self._told_outage.warning("monitor: results are not kept, and wait: %s", error)
                self._stop.wait(AGAIN_S)
            except Exception as error:
                return self._keep_singly(results, error)
            else:
                self._not_kept, self._kept_s = "", time.monotonic()
                return results
        return ()

    def _keep_singly(self, results: Sequence[Received], error: Exception) -> Sequence[Received]:
        """The same, one by one, because one of these results cannot be added; it is counted and left out."""
        if len(results) == 1:
            self._count_fault(error)
            return ()
        return [kept for result in results for kept in self._keep([result])]

    def _show(self, result: Received) -> None:
        a = result.address
        self._fleet.take(a.site, a.gateway, a.sensor, a.what, result.fields)

    def _look(self, consumer: Consumer, session: zenoh.Session, ended: threading.Event) -> None:
        while not ended.wait(LOOK_S):
            heard, where = bool(session.info.routers_zid()), ", ".join(self._endpoints)
            self._not_received = "" if heard else f"no Zenoh router answers at {where}"
            if self._hearing.lost():
                consumer.close()  # then both sessions are opened anew
                return
            self._fleet.set_doubled(consumer.doubled, consumer.in_turns)

    def _take_token(self, token: zenoh.Sample) -> None:
        if (address := parse_key(str(token.key_expr))) is not None:
            self._fleet.set_alive(address.site, address.gateway, token.kind == zenoh.SampleKind.PUT)

    def _take_status(self, sample: zenoh.Sample) -> None:
        if (address := parse_key(str(sample.key_expr))) is not None:
            self._fleet.set_gateway_status(address.site, address.gateway, sample.payload.to_bytes())

    def _take_guide(self, sample: zenoh.Sample) -> None:
        if (address := parse_key(str(sample.key_expr))) is None:
            return
        signed = sample.attachment.to_bytes() if sample.attachment is not None else b""
        try:
            guide = read_guide(sample.payload.to_bytes(), signed, address.source, self._known)
        except UnverifiedError as error:
            self._refused_guides.count(address.source, str(error), sample.payload.to_bytes(), signed)
            return
        if guide is not None:
            self.benches.take(address.site, address.gateway, guide)
