"""The client library: receives every result of the chosen gateways once and in order, also after interruptions."""

from __future__ import annotations

import atexit
import json
import logging
import queue
import threading
import time
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Self

import zenoh
from zenoh.ext import HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from agent.config.known_keys import WatchedKeys
from agent.config.tls import TlsFiles
from agent.delivery import memory as memory_file
from agent.delivery.holding import Held
from agent.delivery.keys import PREFIX, narrow
from agent.delivery.progress import Progress
from agent.delivery.questions import Answer, Dialogue, Questions, Replies, answer_of, steps
from agent.delivery.received import Received, receive
from agent.delivery.seldom import Seldom
from agent.delivery.session import session_config
from agent.delivery.verifying import Refusals, UnverifiedError, Verifier

INBOX = 1000  # samples that may wait; further ones are dropped and later fetched from the gateway's store
CONNECT_S = 10.0
CLOSE_S = 2.0  # that closing waits for the thread that takes samples; it ends at once unless the inbox is full
SAVE_S = 1.0  # s between two writes of the memory file while results come without a pause; a pause writes it at once


__all__ = ["Consumer", "Received"]

_log = logging.getLogger(__name__)


class Consumer:
    """Receives the results under the key expression `key`, through the routers at `endpoints`.

    Iterating yields the results of each gateway in the order of their sequence, each once.
    `last_sequence`: the last result known of each gateway (`<site>/<gateway>`: number, or, better,
    `<site>/<gateway>/<epoch>`: number). Such a gateway begins with the results after that number, any other gateway
    with the values in force. The attribute of this name is in the same form.
    `memory`: a file, made if it does not exist, in which the consumer keeps the last result that it has processed, so
    that it continues there after a restart. A result counts as processed when the next one is asked for. After a crash
    the results of its last second may come again, with the same numbers.

    Each result names the result published before it. Where this is not the last one known, results are missing: the
    consumer asks the gateway's store with `?after=` and holds later results until it answers. After a lost connection
    the newest results come again (history and recovery of Zenoh's advanced subscriber), so that a gap is seen at once.
    Many gateways are asked at once, so that one that does not answer delays no other.
    A result that is not the very next one counts only when the gateway's store has it too. Otherwise it is given with
    `confirmed` false, and does not move the numbers, so that one message of a stranger cannot hide what follows. So is
    a result whose gateway does not answer for five minutes. What waits is bounded (agent.delivery.holding). When
    the gateway's store was made anew, its results have another epoch; the first of them has `new_epoch` true.
    `keys`: a list of known keys (agent.config.known_keys). Then only results are given that a key of their gateway
    signed, with the fields that were signed. Others are refused: logged, and counted by gateway in `refused`. The file
    is read again when it changes. `trust_first`: a gateway without a key in the list gets the key of its first result,
    which is added to the list.
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
        self._refusals = Refusals()
        self._memory = memory
        self._done = memory_file.load(memory) if memory is not None else {}
        self._saved_s = time.monotonic()
        self._saved = dict(self._done)
        self._told: dict[str, int] = {}  # by source: number up to which the user was told that results are removed
        self._progress = Progress(self._done | dict(last_sequence or {}))
        self._unconfirmed: dict[tuple[str, str, int], Received] = {}  # given already, although the store had them not
        self._key = key
        # None: the session is closed.
        self._inbox: queue.Queue[zenoh.Sample | Replies | None] = queue.Queue()
        self._room = threading.Semaphore(INBOX)  # for samples; replies need none, since only so many are asked at once
        self._dialogues: dict[str, Dialogue] = {}  # by source: the gateways that are being asked
        self._held = Held()
        self._doubts = Seldom()
        config = session_config("client", connect=endpoints, tls=tls)
        config.insert_json5("connect/timeout_ms", json.dumps(int(CONNECT_S * 1000)))
        self._open = ExitStack()
        try:
            session = self._open.enter_context(zenoh.open(config))
        except zenoh.ZError:
            raise ConnectionError(f"no Zenoh router answers at {', '.join(endpoints)}") from None
        self._questions = Questions(session, self._inbox)
        subscriber = declare_advanced_subscriber(
            session,
            key,
            zenoh.handlers.RingChannel(INBOX),
            history=HistoryConfig(detect_late_publishers=True),
            recovery=RecoveryConfig(heartbeat=True),  # type: ignore[call-arg]
        )
        self._open.callback(subscriber.undeclare)
        self._taking = threading.Thread(target=self._take_samples, args=(subscriber,), name="consumer", daemon=True)
        self._taking.start()
        # Where Zenoh's thread still runs when the interpreter ends, Python aborts the process.
        atexit.register(self.close)

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
                item = self._inbox.get(timeout=self._held.wait_s())
            except queue.Empty:
                pass
            except KeyboardInterrupt:
                return
            else:
                if item is None:
                    return
                yield from self._take(item)
            for source in self._held.due():
                yield from self._begin(source)

    def _take(self, item: zenoh.Sample | Replies) -> Iterator[Received]:
        if isinstance(item, Replies):
            yield from self._go_on(item.source, item.dialogue, answer_of(item.replies, self._received))
            return
        self._room.release()
        if (result := self._received(item)[0]) is not None:
            yield from self._follow(result)

    def close(self) -> None:
        """End the iteration and the session. May be called twice, from any thread."""
        self._questions.close(self._open.close)
        self._taking.join(CLOSE_S)
        atexit.unregister(self.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take_samples(self, subscriber: Iterable[zenoh.Sample]) -> None:
        for sample in subscriber:
            self._room.acquire()
            self._inbox.put(sample)
        self._inbox.put(None)  # the subscriber is undeclared

    @property
    def last_sequence(self) -> dict[str, int]:
        """The last result that was taken of each gateway and epoch."""
        return dict(self._progress.numbers)

    @property
    def refused(self) -> dict[str, int]:
        """The number of results that were not verified, by the gateway as one of which they were published."""
        return dict(self._refusals.counts)

    @property
    def dropped(self) -> dict[str, int]:
        """The number of results that had to wait for earlier ones and found no place, by gateway; "": of too many."""
        return dict(self._held.dropped)

    def _follow(self, result: Received) -> Iterator[Received]:
        if self._progress.has(result):
            return
        if self._progress.is_next(result):
            yield from self._deliver(result)
            return
        self._held.add(result, known=self._progress.number(result.address.source) is not None)

    def _begin(self, source: str) -> Iterator[Received]:
        """Begin the dialogue with a gateway."""
        self._dialogues[source] = self._dialogue(source)
        yield from self._go_on(source, self._dialogues[source], None)

    def _go_on(self, source: str, dialogue: Dialogue, answer: Answer | None) -> Iterator[Received]:
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

    def _dialogue(self, source: str) -> Dialogue:
        """Ask a gateway for what follows the last result known of it, then give what was held meanwhile."""
        selector = narrow(self._key, source)
        if self._progress.number(source) is None:
            answer = yield selector  # the values in force
            yield from self._deliver(*answer.results, first=True)
            if not answer.results or not self._held_is_new(source):
                yield from self._settle(source, answered=answer.answered)
                return
        yield from self._find_epoch(source, selector)
        epochs = yield from self._other_epochs(source, selector)
        answered = yield from self._pages(source, f"{selector}?after=", self._progress.number(source) or 0, epochs)
        for epoch in epochs:
            yield from self._pages(source, f"{selector}?epoch={epoch};after=", 0, {}, epoch)
        yield from self._settle(source, answered=answered)

    def _settle(self, source: str, *, answered: bool) -> Iterator[Received]:
        """Give what is still held of a gateway that answered, or that has not answered for too long."""
        if self._held.asked(source, answered=answered, known=self._progress.number(source) is not None):
            yield from self._deliver_unconfirmed(*self._held.pop(source))

    def _other_epochs(self, source: str, selector: str) -> Generator[str, Answer, dict[str, None]]:
        """The epochs of held results that are not known yet and that the gateway's store has."""
        held = {r.epoch for r in self._held.of(source) if self._progress.is_other_epoch(r)}
        if not held:
            return {}
        in_force = yield selector
        return dict.fromkeys(r.epoch for r in in_force.results if r.epoch in held)

    def _pages(
        self, source: str, question: str, after: int, others: dict[str, None], epoch: str | None = None
    ) -> Generator[Received | str, Answer, bool]:
        """Ask until nothing more comes; returns whether the gateway answered.

        Results of other epochs are not given, but these epochs are added to `others`; with `epoch`, only its results
        are given.
        """
        while True:
            results, answered, removed, reached = yield f"{question}{after}"
            if reached <= after:
                return answered
            after = reached
            if epoch is None:
                others |= dict.fromkeys(r.epoch for r in results if self._progress.is_other_epoch(r))
                results = [r for r in results if r.epoch not in others]
            else:
                results = [r for r in results if r.epoch == epoch]
            if results and removed > self._told.get(source, 0):
                self._told[source] = removed
                results[0] = replace(results[0], removed_up_to=removed)
            yield from self._deliver(*results)

    def _find_epoch(self, source: str, selector: str) -> Generator[str, Answer, None]:
        """Find the epoch of a number that was given without one: that of the result with this number in the store."""
        known, held = self._progress.number(source), self._held.of(source)
        if known is None or not self._progress.without_epoch(source):
            return
        other = next((r.epoch for r in held if self._progress.is_other_epoch(r)), None)
        if other is None:
            return
        results, _, removed, _ = yield f"{selector}?after={known - 1}"
        if results and results[0].sequence == known:
            self._progress.adopt(source, results[0].epoch, known)
        elif removed >= known:
            self._progress.adopt(source, other, known)

    def _held_is_new(self, source: str) -> bool:
        return not all(self._progress.has(result) for result in self._held.of(source))

    def _deliver(self, *results: Received, first: bool = False) -> Iterator[Received]:
        for result in results:
            source = result.address.source
            if self._progress.has(result):
                continue
            new_epoch = self._progress.is_other_epoch(result) and not (first or self._progress.without_epoch(source))
            if new_epoch:
                _log.warning(
                    "%s counts its results anew, from %d: its store was made anew",
                    result.address.source,
                    result.sequence,
                )
            self._progress.take(result)
            given = self._unconfirmed.pop(_identity(result), None)
            if given is None or given.fields != result.fields:
                yield replace(result, new_epoch=new_epoch) if new_epoch else result
            self._done = self._progress.numbers | {}
            if time.monotonic() - self._saved_s > SAVE_S:
                self._remember()

    def _deliver_unconfirmed(self, *results: Received) -> Iterator[Received]:
        for result in results:
            identity = _identity(result)
            if self._progress.has(result) or identity in self._unconfirmed:
                continue
            self._doubts.warning(
                "%s: result %d is not known to be in its store", result.address.source, result.sequence
            )
            self._unconfirmed[identity] = result
            if len(self._unconfirmed) > INBOX:
                self._unconfirmed.pop(next(iter(self._unconfirmed)))
            yield replace(result, confirmed=False)

    def _remember(self) -> None:
        if self._memory is not None and self._done != self._saved:
            memory_file.save(self._memory, self._done)
            self._saved, self._saved_s = dict(self._done), time.monotonic()

    def _received(self, sample: zenoh.Sample) -> tuple[Received | None, int]:
        """(the result, or None where it is none or is refused; its number, also where it is refused, otherwise 0)."""
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else None
        parts = str(sample.key_expr), sample.payload.to_bytes(), attachment
        try:
            result = receive(*parts, self._verifier)
        except UnverifiedError as error:
            claimed = receive(*parts)
            source = "/".join(parts[0].split("/")[2:4])
            self._refusals.count(source, str(error))
            return None, claimed.sequence if claimed else 0
        if result is not None and result.altered:
            what = "%s: the JSON of result %d says something else than its signed bytes: %s"
            _log.warning(what, result.address.source, result.sequence, ", ".join(result.altered))
        return result, result.sequence if result else 0


def _identity(result: Received) -> tuple[str, str, int]:
    return result.address.source, result.epoch, result.sequence
