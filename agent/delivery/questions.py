"""The questions of a consumer to the stores of gateways: many at once, so that a silent gateway delays no other."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import NamedTuple

import zenoh

from agent.delivery.answers import NOTHING, REMOVED
from agent.delivery.received import Received
from agent.delivery.seldom import Seldom

ANSWER_S = 5.0  # s that one question waits for its answer
REPLIES_MAX, BYTES_MAX = 2000, 16 << 20  # of one answer; a gateway gives 500 results, about 2 MB


class GatewayAnswer(NamedTuple):
    """What a gateway answered. `results`: in order. `removed`: number up to which it has deleted results, or 0.

    `reached`: the highest number in the answer, also of results that were refused; 0 where there is none.
    """

    results: list[Received]
    answered: bool
    removed: int
    reached: int


# Gives results and asks questions (selectors), in this order; what is sent to it is the answer to its last question.
Dialogue = Generator[Received | str, GatewayAnswer, None]


def steps(dialogue: Dialogue, answer: GatewayAnswer | None) -> Iterator[Received | str]:
    """What a dialogue gives after `answer` (None: at its beginning), up to its next question or its end."""
    try:
        step = next(dialogue) if answer is None else dialogue.send(answer)
        while isinstance(step, Received):
            yield step
            step = next(dialogue)
    except StopIteration:
        return
    yield step


class Replies(NamedTuple):
    """All replies to the question of a dialogue; None where there were too many."""

    source: str
    dialogue: Dialogue
    replies: Sequence[zenoh.Reply] | None


class Questions:
    """Asks over a session and hands the replies to `put` when all are there, or after ANSWER_S.

    Zenoh calls back in threads of its own; nothing but collecting is done there.
    """

    def __init__(self, session: zenoh.Session, put: Callable[[Replies], None]) -> None:
        self._session, self._put = session, put
        self._mutex = threading.Lock()  # closing a session while another thread uses it raises an exception there
        self._closed = False
        self._log = Seldom()

    def ask(self, source: str, dialogue: Dialogue, selector: str) -> bool:
        """Ask a gateway; returns False where the session is closed."""
        replies: list[zenoh.Reply] = []
        size = 0

        def take(reply: zenoh.Reply) -> None:
            nonlocal size
            parts = (reply.ok.payload, reply.ok.attachment) if reply.ok else ()
            size += sum(len(part) for part in parts if part is not None)
            if len(replies) <= REPLIES_MAX and size <= BYTES_MAX:
                replies.append(reply)

        def end() -> None:
            too_many = len(replies) > REPLIES_MAX or size > BYTES_MAX
            if too_many:
                self._log.warning(
                    "%s: an answer with too many results is not used; are there two such gateways?", source
                )
            self._put(Replies(source, dialogue, None if too_many else replies))

        handler = zenoh.handlers.Callback(take, end, indirect=False)
        with self._mutex:
            if self._closed:
                return False
            # With consolidation Zenoh would pass on only the last result of each key.
            self._session.get(selector, handler, consolidation=zenoh.ConsolidationMode.NONE, timeout=ANSWER_S)
        return True

    def close(self, closing: Callable[[], None]) -> None:
        """Ask no more, and call `closing` while nobody uses the session."""
        with self._mutex:
            self._closed = True
            closing()


def answer_of(
    replies: Sequence[zenoh.Reply] | None, received: Callable[[zenoh.Sample], tuple[Received | None, int]]
) -> GatewayAnswer:
    """What these replies say. `received` gives the result in a sample, or None, and its number, otherwise 0."""
    answered, removed, reached = False, 0, 0
    results = []
    for reply in replies or ():
        if reply.ok:
            result, number = received(reply.ok)
            results.append(result)
            reached = max(reached, number)
        gone = _removed(reply.err) if reply.err else 0
        removed = max(removed, gone)
        answered |= reply.err is None or gone > 0 or reply.err.payload.to_bytes() == NOTHING
    in_order = sorted((r for r in results if r is not None), key=lambda r: r.sequence)
    return GatewayAnswer(in_order, answered, removed, reached)


def _removed(error: zenoh.ReplyError) -> int:
    """The number in an answer REMOVED; 0 for any other answer."""
    try:
        number = error.payload.to_string().removeprefix(REMOVED)
    except zenoh.ZError:
        return 0
    return int(number) if number.isascii() and number.isdigit() and len(number) < 19 else 0
