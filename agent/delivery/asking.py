"""What a consumer asks a gateway, and which results it then gives: each once, in order, confirmed by its store."""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace

from agent.delivery.holding import WaitingResults
from agent.delivery.keys import narrow
from agent.delivery.progress import Progress
from agent.delivery.questions import Dialogue, GatewayAnswer
from agent.delivery.received import Received
from agent.delivery.seldom import Seldom

UNCONFIRMED_MAX = 1000  # results given as unconfirmed that are remembered, so that none is given so twice

_log = logging.getLogger(__name__)


class Dialogues:
    """The dialogues with gateways about results under the key expression `key`.

    `progress`: how far the consumer has come; what is given moves it. `held`: results that wait for earlier ones.
    """

    def __init__(self, key: str, progress: Progress, held: WaitingResults) -> None:
        self._key, self._progress, self._held = key, progress, held
        self._told: dict[str, int] = {}  # by source: number up to which the user was told that results are removed
        self._unconfirmed: dict[tuple[str, str, int], Received] = {}  # given already, although the store had them not
        self._doubts = Seldom()

    def dialogue(self, source: str) -> Dialogue:
        """Ask a gateway for what follows the last result known of it, then give what was held meanwhile."""
        selector = narrow(self._key, source)
        if self._progress.number(source) is None:
            answer = yield selector  # the values in force
            yield from self.deliver(*answer.results, first=True)
            if not answer.results or not self._held_is_new(source):
                yield from self._settle(source, answered=answer.answered)
                return
        signs = self._held.of(source) or (yield from self._newest(source, selector))
        if signs is None:
            yield from self._settle(source, answered=False)
            return
        yield from self._find_epoch(source, selector, signs)
        epochs = yield from self._other_epochs(selector, signs)
        answered = yield from self._pages(source, f"{selector}?after=", self._progress.number(source) or 0, epochs)
        for epoch in epochs:
            yield from self._pages(source, f"{selector}?epoch={epoch};after=", 0, {}, epoch)
        yield from self._settle(source, answered=answered)

    def _settle(self, source: str, *, answered: bool) -> Iterator[Received]:
        """Give what is still held of a gateway that answered, or that has not answered for too long."""
        if self._held.asked(source, answered=answered, known=self._progress.number(source) is not None):
            yield from self._deliver_unconfirmed(*self._held.pop(source))

    def _newest(self, source: str, selector: str) -> Generator[str, GatewayAnswer, Sequence[Received] | None]:
        """Results of the epoch that the gateway's store has now; None where it does not answer."""
        last = self._progress.number(source) or 0
        answer = yield f"{selector}?after={max(0, last - 1)}"  # the last one known, where the store still has it
        if answer.answered and not answer.results:  # the store was made anew and counts lower, or retention was there
            answer = yield selector
        return answer.results if answer.answered else None

    def _other_epochs(self, selector: str, signs: Sequence[Received]) -> Generator[str, GatewayAnswer, dict[str, None]]:
        """The epochs of these results that are not known yet and that the gateway's store has."""
        other = {r.epoch for r in signs if self._progress.is_other_epoch(r)}
        if not other:
            return {}
        in_force = yield selector
        return dict.fromkeys(r.epoch for r in in_force.results if r.epoch in other)

    def _pages(
        self, source: str, question: str, after: int, others: dict[str, None], epoch: str | None = None
    ) -> Generator[Received | str, GatewayAnswer, bool]:
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
            yield from self.deliver(*results)

    def _find_epoch(self, source: str, selector: str, signs: Sequence[Received]) -> Generator[str, GatewayAnswer, None]:
        """Find the epoch of a number that was given without one: that of the result with this number in the store."""
        known = self._progress.number(source)
        if known is None or not self._progress.without_epoch(source):
            return
        other = next((r.epoch for r in signs if self._progress.is_other_epoch(r)), None)
        if other is None:
            return
        results, _, removed, _ = yield f"{selector}?after={known - 1}"
        if results and results[0].sequence == known:
            self._progress.adopt(source, results[0].epoch, known)
        elif removed >= known:
            self._progress.adopt(source, other, known)

    def _held_is_new(self, source: str) -> bool:
        return not all(self._progress.has(result) for result in self._held.of(source))

    def deliver(self, *results: Received, first: bool = False) -> Iterator[Received]:
        """Give results of one gateway, which its store has or which are its next ones, without those given before.

        `first`: they are the first ones of a gateway, so that no other epoch was before them.
        """
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

    def _deliver_unconfirmed(self, *results: Received) -> Iterator[Received]:
        for result in results:
            identity = _identity(result)
            if self._progress.has(result) or identity in self._unconfirmed:
                continue
            self._doubts.warning(
                "%s: result %d is not known to be in its store", result.address.source, result.sequence
            )
            self._unconfirmed[identity] = result
            if len(self._unconfirmed) > UNCONFIRMED_MAX:
                self._unconfirmed.pop(next(iter(self._unconfirmed)))
            yield replace(result, confirmed=False)


def _identity(result: Received) -> tuple[str, str, int]:
    return result.address.source, result.epoch, result.sequence
