"""The client library: receives every result of the chosen gateways once and in order, also after interruptions."""

from __future__ import annotations

import atexit
import json
import logging
import queue
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from enum import Enum, auto
from itertools import chain
from pathlib import Path
from typing import Self

import zenoh

from agent.config.known_keys import WatchedKeys
from agent.config.tls import TlsFiles
from agent.delivery.asking import Dialogues
from agent.delivery.hearing import Hearing
from agent.delivery.holding import WaitingResults
from agent.delivery.instances import Instances
from agent.delivery.keys import PREFIX, parse_key
from agent.delivery.memory import ProcessedNumbers
from agent.delivery.presence import Presence
from agent.delivery.progress import Progress
from agent.delivery.questions import Dialogue, GatewayAnswer, Questions, Replies, answer_of, steps
from agent.delivery.received import Received, number_of, receive
from agent.delivery.session import close_in_time, session_config
from agent.delivery.turns import Turns
from agent.delivery.verifying import Refusals, UnverifiedError, Verifier

INBOX = 1000  # samples that may wait; further ones are dropped and later fetched from the gateway's store
CONNECT_S = 10.0
RECONNECT_S = 2.0  # s between two attempts to reach a router again with another session
LOOK_S = 1.0  # s between two looks whether the router still hears
CLOSE_S = 1.0  # s that closing waits for the thread that takes samples; it ends at once unless the inbox is full


__all__ = ["Consumer", "Received"]

_log = logging.getLogger(__name__)


class _Wake(Enum):
    """What ends waiting beside samples and replies: gateways that come or go, and the end."""

    NEWS = auto()
    CLOSED = auto()


class Consumer:
    """Receives the results under the key expression `key`, through the routers at `endpoints`.

    Iterating yields the results of each gateway in the order of their sequence, each once. `batches` yields the same as
    lists, for a user who takes many at a time.
    `last_sequence`: the last result known of each gateway (`<site>/<gateway>`: number, or, better,
    `<site>/<gateway>/<epoch>`: number). Such a gateway begins with the results after that number, any other gateway
    with the values in force. The attribute of this name is in the same form.
    `memory`: a file, made if it does not exist, in which the consumer keeps the last result that it has processed, so
    that it continues there after a restart. A result, or a batch, counts as processed when the next one is asked for.
    After a crash the results of its last second may come again, with the same numbers.

    Each result names the result published before it. Where this is not the last one known, results are missing: the
    consumer asks the gateway's store with `?after=` and holds later results until it answers. It also asks each gateway
    that appears on the bus, also after a lost connection, and then about once a minute (agent.delivery.presence).
    Many gateways are asked at once, so that one that does not answer delays no other.
    A result that is not the very next one counts only when the gateway's store has it too. Otherwise it is given with
    `confirmed` false, and does not move the numbers, so that one message of a stranger cannot hide what follows. So is
    a result whose gateway does not answer for five minutes. What waits is bounded (agent.delivery.holding). When
    the gateway's store was made anew, its results have another epoch; the first of them has `new_epoch` true.
    `keys`: a list of known keys (agent.config.known_keys). Then only results are given that a key of their gateway
    signed, with the fields that were signed. Others are refused: logged, and counted by gateway in `refused`. The file
    is read again when it changes. `trust_first`: a gateway without a key in the list gets the key of its first result,
    which is added to the list.
    A session that the router does not hear is replaced by another one (agent.delivery.hearing).
    `close` may be called from another thread than the one that iterates. Ctrl-C while the consumer waits for a result
    ends the iteration, as `close` does. At the end of the program the consumer closes itself.
    Raises EndpointError, ConnectionError, MemoryFileError or KeyFileError; iterating raises OSError where `memory`
    cannot be written.
    """

    def __init__(
        self,
        endpoints: Sequence[str],
        key: str = f"{PREFIX}/**",
        last_sequence: Mapping[str, int] | None = None,
        memory: Path | None = None,
        *,
        tls: TlsFiles | None = None,
        keys: Path | None = None,
        trust_first: bool = False,
    ) -> None:
        self._verifier = Verifier(WatchedKeys(keys), trust_first=trust_first) if keys is not None else None
        self._refusals, self._malformed = Refusals(), Refusals()
        self._memory = ProcessedNumbers(memory)
        self._progress = Progress(self._memory.numbers | dict(last_sequence or {}))
        self._inbox: queue.Queue[zenoh.Sample | Replies | _Wake] = queue.Queue()
        self._room = threading.Semaphore(INBOX)  # for samples; replies need none, since only so many are asked at once
        self._dialogues: dict[str, Dialogue] = {}  # by source: the gateways that are being asked
        self._turns = Turns()
        self._held = WaitingResults()
        self._asking = Dialogues(key, self._progress, self._held)
        self._config = session_config("client", connect=endpoints, tls=tls)
        self._config.insert_json5("connect/timeout_ms", json.dumps(int(CONNECT_S * 1000)))
        self._key, self._endpoints = key, endpoints
        self._hearing = Hearing()
        self._changing = threading.Lock()  # held while the session is replaced or closed
        self._closed = threading.Event()
        self._connect()
        # Where Zenoh's thread still runs when the interpreter ends, Python aborts the process.
        atexit.register(self.close)

    def _connect(self) -> None:
        """Open a session, and all that is declared in it. Raises ConnectionError."""
        opened = ExitStack()
        try:
            session = opened.enter_context(zenoh.open(self._config))
        except zenoh.ZError:
            raise ConnectionError(f"no Zenoh router answers at {', '.join(self._endpoints)}") from None
        with self._changing:
            self._open = opened
            self._questions = Questions(session, self._inbox.put)
            # A plain one: an advanced subscriber asks each publisher of each gateway for its history after a lost
            # connection and gets heartbeats of all of them, which a router of 1,000 gateways cannot stand
            # (docs/fleet-evidence.md).
            subscriber = session.declare_subscriber(self._key, zenoh.handlers.RingChannel(INBOX))
            opened.callback(subscriber.undeclare)
            self._presence = Presence(session, self._key, lambda: self._inbox.put(_Wake.NEWS))
            opened.callback(self._presence.close)
            self._instances = Instances(session, self._key)
            opened.callback(self._instances.close)
            self._taking = threading.Thread(target=self._take_samples, args=(subscriber,), name="consumer", daemon=True)
            self._taking.start()
            self._hearing.begin(session)
            if self._closed.is_set():
                self._close_session()

    def _is_lost(self) -> bool:
        with self._changing:
            return not self._closed.is_set() and self._hearing.lost()

    def _reconnect(self) -> None:
        """Open another session in place of this one, as soon as a router answers."""
        self._close_session()
        while not self._closed.is_set():
            try:
                self._connect()
            except ConnectionError:
                self._closed.wait(RECONNECT_S)
            else:
                return

    def __iter__(self) -> Iterator[Received]:
        for batch in self.batches(1):
            yield from batch

    def batches(self, most: int) -> Iterator[list[Received]]:
        """The results that have come, in lists of at most `most`. No result waits for others to come."""
        batch: list[Received] = []
        try:
            for result in chain(self._results(), (None,)):
                if result is not None:
                    self._turns.taken(result)
                    batch.append(result)
                if batch and (result is None or len(batch) >= most):
                    yield batch
                    self._memory.processed(self._progress.numbers | {})
                    batch = []
                if result is None:
                    self._memory.save()
        finally:
            self._memory.save()

    def _results(self) -> Iterator[Received | None]:
        """The results; None when no more have come."""
        while True:
            if self._inbox.empty():
                yield None
            try:
                if self._is_lost():
                    self._reconnect()
                item = self._inbox.get(timeout=self._wait_s())
            except queue.Empty:
                pass
            except KeyboardInterrupt:
                return
            else:
                if item is _Wake.CLOSED:
                    return
                if item is not _Wake.NEWS:
                    yield from self._take(item)
            self._instances.look()
            for source in self._presence.due(self._held.room()):
                self._held.look(source, known=self._progress.number(source) is not None)
            for source in self._held.due():
                yield from self._begin(source)

    def _wait_s(self) -> float:
        waits = LOOK_S, self._held.wait_s(), self._presence.wait_s() if self._held.room() else None
        return min(wait_s for wait_s in waits if wait_s is not None)

    def _take(self, item: zenoh.Sample | Replies) -> Iterator[Received]:
        if isinstance(item, Replies):
            yield from self._go_on(item.source, item.dialogue, answer_of(item.replies, self._read_sample))
            return
        self._room.release()
        if (result := self._read_sample(item)[0]) is not None:
            yield from self._follow(result)

    def close(self) -> None:
        """End the iteration and the session. May be called twice, from any thread."""
        self._closed.set()
        with self._changing:
            self._close_session()
        self._inbox.put(_Wake.CLOSED)
        self._taking.join(CLOSE_S)
        atexit.unregister(self.close)

    def _close_session(self) -> None:
        self._questions.close(lambda: close_in_time(self._open.close))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take_samples(self, subscriber: Iterable[zenoh.Sample]) -> None:
        for sample in subscriber:
            self._room.acquire()
            self._inbox.put(sample)

    @property
    def last_sequence(self) -> dict[str, int]:
        """The last result that was taken of each gateway and epoch."""
        return dict(self._progress.numbers)

    @property
    def refused(self) -> dict[str, int]:
        """The number of results that were not verified, by the gateway as one of which they were published."""
        return dict(self._refusals.counts)

    @property
    def doubled(self) -> dict[str, tuple[str, ...]]:
        """The ids of the runs that are on the bus together, of each gateway that is there more than once.

        Such gateways count their results alike, so each number is given once, of one of them. The results say of which
        by `run_id`.
        """
        return self._instances.doubled

    @property
    def in_turns(self) -> dict[str, tuple[str, str]]:
        """The ids of two runs of each gateway that publish in its name in turns (agent.delivery.turns), since the
        start of this consumer."""
        return dict(self._turns.found)

    @property
    def malformed(self) -> dict[str, int]:
        """The number of messages at the key of a result that are none, by the gateway in whose name they came."""
        return dict(self._malformed.counts)

    @property
    def dropped(self) -> dict[str, int]:
        """The number of results that had to wait for earlier ones and found no place, by gateway; "": of too many."""
        return dict(self._held.dropped)

    def _follow(self, result: Received) -> Iterator[Received]:
        if self._progress.has(result):
            self._turns.came_again(result)
            return
        if self._progress.is_next(result):
            yield from self._asking.deliver(result)
            return
        self._held.add(result, known=self._progress.number(result.address.source) is not None)

    def _begin(self, source: str) -> Iterator[Received]:
        """Begin the dialogue with a gateway."""
        self._dialogues[source] = self._asking.dialogue(source)
        yield from self._go_on(source, self._dialogues[source], None)

    def _go_on(self, source: str, dialogue: Dialogue, answer: GatewayAnswer | None) -> Iterator[Received]:
        """Hand an answer to the dialogue with a gateway, and give its results up to its next question."""
        if self._dialogues.get(source) is not dialogue:
            return
        asked = False
        try:
            for step in steps(dialogue, answer):
                if isinstance(step, Received):
                    yield step
                else:
                    asked = self._questions.ask(source, dialogue, step)
        finally:
            if not asked:  # it ended, or the user takes no more results
                del self._dialogues[source]
                self._held.ended(source)
        if not asked:
            for result in self._held.pop_later(source):
                yield from self._follow(result)

    def _read_sample(self, sample: zenoh.Sample) -> tuple[Received | None, int]:
        """(the result, or None where it is none or is refused; the number that it claims, otherwise 0)."""
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else None
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        signed = (attachment or b"").partition(b"\n")[2]
        try:
            result = receive(key, payload, attachment, self._verifier)
        except UnverifiedError as error:
            self._refusals.count("/".join(key.split("/")[2:4]), str(error), payload, signed)
            return None, number_of(payload)
        if result is None:
            if (address := parse_key(key)) is None or not address.is_result:
                return None, 0
            self._malformed.count(address.source, "it has not the fields and numbers of its kind", payload, signed)
            return None, number_of(payload)
        if result.altered:
            what = "%s: the JSON of result %d says something else than its signed bytes: %s"
            _log.warning(what, result.address.source, result.sequence, ", ".join(result.altered))
        return result, result.sequence
