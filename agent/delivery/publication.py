"""Publishes a gateway's results over Zenoh, in order, from the outbox. It never delays the rest of the agent."""

from __future__ import annotations

import atexit
import logging
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import zenoh
from zenoh.ext import AdvancedPublisher, CacheConfig, MissDetectionConfig, declare_advanced_publisher

from agent.config.tls import TlsFiles, expiry_warning
from agent.delivery.answers import answer_queries, attachment_of
from agent.delivery.hearing import Hearing
from agent.delivery.history import History, StoredResult, StoreError
from agent.delivery.instances import watch_own_name
from agent.delivery.keys import gateway_key, result_key
from agent.delivery.session import closed_in_time, session_config
from agent.delivery.store import Store
from agent.delivery.taken import Taken

BATCH = 100  # results read from the store at a time
POLL_S = 0.2  # s after which a router that came back is noticed; asking takes a microsecond
SETTLE_S = 0.2  # s to wait for a new router to name its subscribers; samples put before reach only the cache
REOPEN_S = 5.0  # s between two attempts to open a session
EXPIRY_S = 86_400.0  # s between two looks at the certificates, of which Zenoh reads new files at each new link
CACHE_SAMPLES = 100  # samples per channel for subscribers that come later; older results are in the store
HEARTBEAT_S = 10.0  # s between messages that let a subscriber notice a missed last sample; 40 bytes for each subscriber
RECENT_MAX = 1000  # newest results; those that the store could not write are published from here
BLOCKS_MAX = 64  # blocks of the corrected stream that may wait, half a minute of one sensor; older ones are dropped
UNHEARD = "the router was connected and did not answer; the session was opened anew, and is not yet known to be heard"
TAKEN_S, TAKEN_POLL_S = 0.3, 0.01  # s to wait at the end for the answer that the last results were taken; between looks
CLOSE_S = 1.2  # s to wait at the end; a router that does not respond blocks a put for 5 s

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class PublicationState:
    """The state of the publisher. `connected`: whether to a router. `published`: the last published result.

    `reopened`: sessions that were closed because the router did not hear them (agent.delivery.hearing).
    """

    key: str
    endpoints: tuple[str, ...]
    connected: bool
    published: int
    fault: str  # "" where there is none
    reopened: int = 0


class Publisher:
    """Publishes the results of a gateway in the order of their sequence, each after the store has it.

    The store is the outbox. A result counts as published when a router is known to have taken it
    (agent.delivery.taken). What was put before a connection broke, and is not known to be taken, is put again when a
    router is there; so a subscriber may get a result twice. Consumers can also query results (`?after=<sequence>`, see
    agent.delivery.answers). A session that the router does not hear is closed, and another one opened
    (agent.delivery.hearing).
    The attachment of each sample begins with the number of the result put before it, or "0" where this number has no
    meaning: for a result that is put again at the start, or that the store could not write. A consumer that has another
    last number has missed results, or must ask. Where the gateway has a key, a line break and the signed result follow.

    `site`, `gateway`: names. `connect`: endpoints of routers. The session is a peer that does not listen; it connects
    when a router appears. With the `mode` "client" it opens faster, but only while a router is there.
    `poll_s`: time in s after which a router that came back is noticed.
    `tls`: certificates, for endpoints tls/... `serve(session, open_things)` is called with each
    new session. `instance`: the id of this run, by which two gateways with one name are found
    (agent.delivery.instances). If it is "" one is drawn, and this gateway does not look for others with its name.
    Raises ValueError for an invalid name, EndpointError for an invalid endpoint. The methods raise nothing.
    """

    def __init__(
        self,
        site: str,
        gateway: str,
        connect: Sequence[str],
        store: Store,
        *,
        tls: TlsFiles | None = None,
        mode: Literal["peer", "client"] = "peer",
        poll_s: float = POLL_S,
        serve: Callable[[zenoh.Session, ExitStack], None] | None = None,
        instance: str = "",
    ) -> None:
        self._key = gateway_key(site, gateway)
        self._endpoints = tuple(connect)
        self._config = session_config(mode, connect=connect, tls=tls, one_of_many=True)
        # One queue for each link, so that nothing overtakes a result, nor the question whether it was taken.
        self._config.insert_json5("transport/unicast/qos/enabled", "false")
        self._tls = tls
        self._poll_s = poll_s
        self._serve_more = serve
        self._instance, self._looks = instance or uuid.uuid4().hex, bool(instance)
        self._store = store
        self._recent: deque[StoredResult] = deque(maxlen=RECENT_MAX)
        self._blocks: deque[tuple[str, bytes]] = deque(maxlen=BLOCKS_MAX)
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._connected = False
        self._fault = ""
        self._said = ""
        self._expiry, self._expiry_look_s = "", 0.0  # what is said of certificates; monotonic time of the next look
        self._put_up_to = self._previous = store.published()  # `_previous` may be of a result that the store has not
        self._publishers: dict[str, AdvancedPublisher] = {}
        self._told: dict[str, bytes] = {}  # the newest of what the gateway says of itself, by the end of its key
        self._told_put: dict[str, bytes] = {}
        self._hearing, self._taken = Hearing(), Taken()
        self._thread = threading.Thread(target=self._run, name="publication", daemon=True)
        self._other = ""  # what is said where another gateway has this name
        looking = session_config("client", connect=connect, tls=tls), self._key, self._stop, self._note_other_gateway
        self._name_watch = threading.Thread(target=watch_own_name, args=looking, name="own name", daemon=True)

    def start(self) -> None:
        """Start publishing in a thread of its own."""
        # In case nobody calls `close`: a thread that returns from Zenoh during the interpreter's shutdown aborts it.
        atexit.register(self.close)
        self._thread.start()

    def publish(self, record: StoredResult) -> None:
        """Publish a result in its order. Call it after the commit, also after one that failed. Returns at once."""
        self._recent.append(record)
        self._wake.set()

    def stream(self, sensor: str, block: bytes) -> None:
        """Publish a block of the corrected stream as soon as possible. It is not stored. Returns at once."""
        self._blocks.append((sensor, block))  # without a router the oldest blocks are dropped
        self._wake.set()

    def tell_status(self, status: bytes) -> None:
        """Publish the gateway's status (JSON) at `<gateway>/status`. Returns at once.

        Only the newest status is published, and none is stored. It is not a result: it has no sequence number, and a
        query with `?after=` does not return it.
        """
        self._tell("status", status)

    def tell_head(self, head: bytes) -> None:
        """Publish the head of the recordings (agent.recording.head) at `<gateway>/head`. Returns at once."""
        self._tell("head", head)

    def _tell(self, what: str, value: bytes) -> None:
        self._told = self._told | {what: value}  # replaced, since other threads read it
        self._wake.set()

    def state(self) -> PublicationState:
        """The present state, for the terminal and the gateway's status."""
        unheard = UNHEARD if self._hearing.doubtful else ""
        fault = "; ".join(filter(None, (self._fault or unheard, self._other, self._expiry)))
        return PublicationState(
            self._key, self._endpoints, self._connected, self._store.published(), fault,
            self._hearing.reopened,
        )  # fmt: skip

    def close(self, timeout_s: float = CLOSE_S) -> bool:
        """Publish what waits if a router is connected, and close; give up after `timeout_s` s. May be called twice.

        Returns False where a router that does not respond still blocks the thread.
        """
        atexit.unregister(self.close)
        self._stop.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._serve()
            except (zenoh.ZError, StoreError) as error:
                self._fail(str(error))
                self._stop.wait(REOPEN_S)
            self._connected = False
        if self._name_watch.ident is not None:
            self._name_watch.join(CLOSE_S)

    def _serve(self) -> None:
        with ExitStack() as open_things:
            session = open_things.enter_context(closed_in_time(zenoh.open(self._config)))
            history = open_things.enter_context(self._store.history())
            queryable = session.declare_queryable(f"{self._key}/**", zenoh.handlers.FifoChannel(64), complete=True)
            answers = threading.Thread(
                target=answer_queries,
                args=(queryable, self._key, self._store.history, lambda: self._told),
                name="answers",
                daemon=True,
            )
            answers.start()
            open_things.callback(answers.join, CLOSE_S)
            open_things.callback(queryable.undeclare)
            if self._serve_more is not None:
                self._serve_more(session, open_things)
            for key in (f"{self._key}/alive", f"{self._key}/alive/{self._instance}"):
                open_things.callback(session.liveliness().declare_token(key).undeclare)
            # Before the session closes, otherwise Zenoh leaks the memory of the publishers. Deleting an advanced one
            # undeclares it without the lock of the interpreter; its `undeclare` holds that while it waits for locks.
            open_things.callback(self._publishers.clear)
            self._hearing.begin(session)
            self._taken.begin(session)
            for record in history.latest():
                if record.sequence <= self._store.published():
                    self._put(session, record, previous=0)
            self._told_put = {}
            stopping = False
            while not stopping:
                stopping = self._stop.is_set()  # read first: the last round then sends all that was handed over
                self._look_at_certificates()
                if self._find_router(session):
                    self._send_status(session)
                    self._send_waiting(session, history)
                    self._send_blocks(session)
                    self._note_taken(within_s=TAKEN_S if stopping else 0.0)
                if self._hearing.lost():
                    return
                self._wake.wait(0 if stopping else self._poll_s)
                self._wake.clear()

    def _look_at_certificates(self) -> None:
        if self._tls is None or time.monotonic() < self._expiry_look_s:
            return
        self._expiry_look_s = time.monotonic() + EXPIRY_S
        warning = expiry_warning(self._tls, datetime.now(UTC))
        self._expiry = f"zenoh.tls.{warning}" if warning else ""
        if warning:
            _log.warning("%s", self._expiry)

    def _note_other_gateway(self, words: str) -> None:
        self._other = words

    def _find_router(self, session: zenoh.Session) -> bool:
        connected = bool(session.info.routers_zid())
        changed = self._taken.links_changed()
        if changed:
            self._put_up_to = self._previous = self._store.published()
        if connected and (changed or not self._connected):
            self._stop.wait(SETTLE_S)
            if self._looks and self._name_watch.ident is None:
                self._name_watch.start()
        self._connected = connected
        return connected

    def _send_status(self, session: zenoh.Session) -> None:
        for what, value in self._told.items():
            if value != self._told_put.get(what):
                self._publisher(session, result_key(self._key, "", what), cached=1).put(value)
                self._told_put[what] = value

    def _send_waiting(self, session: zenoh.Session, history: History) -> None:
        self._fault = ""
        try:
            while records := history.after(self._put_up_to, limit=BATCH):
                for record in records:
                    if not session.info.routers_zid():
                        return
                    self._put(session, record, self._previous)
                    self._put_up_to = record.sequence
                self._note_taken()
                if self._stop.is_set() and len(records) == BATCH:
                    return  # the rest of a long backlog waits for the next run
        except StoreError as error:
            self._fail(str(error))
        while self._recent:
            record = self._recent.popleft()
            if record.sequence > self._previous:
                self._put(session, record, previous=0)  # the number before it may be in the store only

    def _note_taken(self, within_s: float = 0.0) -> None:
        """Mark as published what the routers have taken; wait so long for their answer, where one is missing."""
        end_s = time.monotonic() + within_s
        while True:
            self._store.mark_published(self._taken.up_to(self._put_up_to))
            if self._store.published() >= self._put_up_to or time.monotonic() >= end_s:
                return
            time.sleep(TAKEN_POLL_S)

    def _send_blocks(self, session: zenoh.Session) -> None:
        while self._blocks:
            sensor, block = self._blocks.popleft()
            # DROP: a slow consumer loses blocks, and does not delay the results.
            session.put(
                result_key(self._key, sensor, "acceleration"),
                block,
                encoding=zenoh.Encoding.APPLICATION_PROTOBUF,
                congestion_control=zenoh.CongestionControl.DROP,
            )

    def _put(self, session: zenoh.Session, record: StoredResult, previous: int) -> None:
        key = result_key(self._key, record.sensor, record.what)
        attachment = attachment_of(record, str(previous))
        self._publisher(session, key, cached=CACHE_SAMPLES).put(record.payload, attachment=attachment)
        self._previous = max(self._previous, record.sequence)

    def _publisher(self, session: zenoh.Session, key: str, cached: int) -> AdvancedPublisher:
        if key not in self._publishers:
            self._publishers[key] = declare_advanced_publisher(
                session,
                key,
                encoding=zenoh.Encoding.APPLICATION_JSON,
                # BLOCK: only this thread waits, and on one link no later result can overtake an earlier one.
                congestion_control=zenoh.CongestionControl.BLOCK,
                cache=CacheConfig(max_samples=cached),
                sample_miss_detection=MissDetectionConfig(heartbeat=HEARTBEAT_S),  # type: ignore[call-arg]
                publisher_detection=True,
            )
        return self._publishers[key]

    def _fail(self, fault: str) -> None:
        if fault != self._said:
            _log.warning("publication: %s", fault)
        self._fault = self._said = fault
