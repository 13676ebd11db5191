"""Which results the routers have taken. Zenoh does not acknowledge a put, so the routers are asked after it."""

from __future__ import annotations

import zenoh

from agent.delivery.hearing import Question


class Taken:
    """Tells up to which number the routers of a session have read what was put; for one thread.

    The session has one queue for each link (agent.delivery.publication), so a router that answers has read all that
    was put before the question. Zenoh also ends a question whose link breaks. Therefore an answer counts only while the
    links are those on which it was asked: a new connection has another port.
    """

    def begin(self, session: zenoh.Session) -> None:
        """A session was opened. What follows is about this one."""
        self._session = session
        self._links: set[tuple[str, str]] = set()
        self._question: Question | None = None
        self._asked_after = 0

    def links_changed(self) -> bool:
        """Whether there are other links than before: what was put and not known to be taken may be lost with one."""
        links = self._present()
        changed, self._links = links != self._links, links
        if changed:
            self._question, self._asked_after = None, 0
        return changed

    def up_to(self, last: int) -> int:
        """The number up to which all is known to be taken, 0 where nothing new is; asks where `last` is put meanwhile.

        Call it with the number of the last result put, again and again.
        """
        taken = 0
        if self._question is not None and self._question.ended():
            if self._question.answered and self._present() == self._links:
                taken = self._asked_after
            else:
                self._asked_after = 0
            self._question = None
        if self._question is None and last > self._asked_after:
            self._question, self._asked_after = Question(self._session), last
        return taken

    def _present(self) -> set[tuple[str, str]]:
        return {(link.src, link.dst) for link in self._session.info.links()}
