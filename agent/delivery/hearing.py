"""Whether the router hears a session that counts as connected.

A router gives a new link some time (`transport/unicast/accept_timeout`, 10 s if nobody sets it). Where the time ends
after the router has agreed, but before it begins to read, Zenoh 1.10 leaves a link on which it sends and never reads.
The session then counts as connected for ever, and nothing that it declares or sends arrives. This happens when many
gateways come back to a router at once.
"""

from __future__ import annotations

import logging
import random
import time

import zenoh

from agent.delivery.keys import PREFIX

NOBODY = f"{PREFIX}/nobody"  # no gateway has such a token, so that the answer has no bytes
ASK_S = 60.0  # s between two questions, half as much at least and once more as much at most
LONGEST_S = 3600.0  # s; at most so long from a new session to its first question
# s to wait for an answer. Longer than 10 s, after which Zenoh gives a link up that shows no sign of life: a router that
# stands still loses its links by itself, and one that is slow because all gateways come back gets no more work.
ANSWER_S = 30.0
REPLIES_MAX = 16  # that wait to be taken; each router gives one at most
MISSES = 2  # questions in a row without answer: the first may have been lost with a link that was then replaced

_log = logging.getLogger(__name__)


class Hearing:
    """Asks the router now and then; for one thread, over all sessions that this thread opens one after the other.

    The question is for a liveliness token that nobody has. A router answers at once, also where its access rules do not
    allow this question. `reopened`: the number of sessions that no router heard.
    The time to the first question is twice as long after each such session, LONGEST_S at most, until a router answers:
    a router that never answers is not flooded with new sessions.
    """

    def __init__(self) -> None:
        self.reopened = 0
        self._in_a_row = 0  # sessions that no router heard

    @property
    def doubtful(self) -> bool:
        """Whether the session before this one was not heard, and this one is not known to be."""
        return self._in_a_row > 0

    def begin(self, session: zenoh.Session) -> None:
        """A session was opened. The next questions are about this one."""
        self._session = session
        self._routers: list[zenoh.ZenohId] = []

    def lost(self) -> bool:
        """Ask if it is time; True once where no router hears the session: close it, and open another one."""
        routers = self._session.info.routers_zid()
        if routers != self._routers:
            self._routers, self._misses, self._question = routers, 0, None
            self._plan(min(ASK_S * 2**self._in_a_row, LONGEST_S))
        if not routers or time.monotonic() < self._next_s:
            return False
        if self._question is None:
            self._question = Question(self._session)
        if not self._question.ended():
            return False
        answered, self._question = self._question.answered, None
        self._misses = 0 if answered else self._misses + 1
        if answered:
            self._in_a_row = 0
            self._plan(ASK_S)
        if self._misses < MISSES:
            return False
        self._in_a_row += 1
        self.reopened += 1
        what = "a connected router has not answered for %.0f s; the session is opened anew (number %d of this run)"
        _log.warning(what, MISSES * ANSWER_S, self.reopened)
        return True

    def _plan(self, after_s: float) -> None:
        self._next_s = time.monotonic() + after_s * random.uniform(0.5, 1.5)


class Question:
    """Whether the routers read what a session sends, asked when it is made.

    `answered`: False where the time was over; it holds once the question has `ended`.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self.answered = True
        # No callback: Zenoh 1.10 ends the answer to such a question while it holds a lock of the session. The end of a
        # callback would there wait for the lock of the interpreter, which a thread that waits for Zenoh may hold.
        self._replies = session.liveliness().get(NOBODY, zenoh.handlers.FifoChannel(REPLIES_MAX), timeout=ANSWER_S)

    def ended(self) -> bool:
        """Whether the answer is complete."""
        try:
            while (reply := self._replies.try_recv()) is not None:
                if reply.ok is None:  # that the time is over
                    self.answered = False
        except zenoh.ZError:  # no reply will come any more
            return True
        return False
