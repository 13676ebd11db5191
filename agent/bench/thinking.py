"""The computing of a session, in a process of its own: in this one it would delay the reading of the devices."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from agent.bench.measuring import Measuring, Record, Taken
from agent.bench.session import Fit, Outlook, Session, expected_of
from calib.estimate.next_stop import Suggestion
from calib.model import Array, Window

NICE = 5
VERY_LONG = 100.0  # times as long a stay, to see what more time would gain


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What the samples of the present stop show: why it cannot be used, "" if it can.

    `left_out` of `points` samples were knocks. `expanded` (9,) is U with this stop, `gain` the factor by which a very
    long stay would reduce the worst of it.
    """

    reason: str
    points: int = 0
    left_out: int = 0
    expanded: Array | None = None
    gain: float = np.inf
    fit: Fit | None = None


class Thinking:
    """A session and its measuring. Each method computes in the other process."""

    def __init__(self, session: Session, measuring: Measuring) -> None:
        self.session, self.measuring = session, measuring

    def __enter__(self) -> Thinking:
        spawn = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(1, mp_context=spawn, initializer=_modest)
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def next_stop(self) -> tuple[Suggestion, Outlook]:
        """The stop that gains most, and how far it is to what is wanted."""
        return self._pool.submit(_next_stop, self.session).result()

    def look(self, record: Record, taken: Taken) -> Look:
        """Look at the stop that is being taken."""
        return self._pool.submit(_look, self.session, self.measuring, record, taken).result()

    def take(self, record: Record, taken: Sequence[Taken]) -> tuple[str, ...]:
        """Adjust all stops; none at all begins anew. Where all is as wanted: why the result would be refused."""
        future = self._pool.submit(_take, self.session, self.measuring, record, taken)
        self.session, self.measuring, refused = future.result()
        return refused


def _modest() -> None:
    """Leave the processor to the reading of devices, and Ctrl-C to the process that has the session."""
    os.nice(NICE)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _next_stop(session: Session) -> tuple[Suggestion, Outlook]:
    return session.suggestion(), session.outlook()


def _look(session: Session, measuring: Measuring, record: Record, taken: Taken) -> Look:
    made = measuring.newest(record, taken)
    used = [w for w in made if w.used]
    if not used:
        return Look(next((w.reason for w in made if w.reason), "too few samples"))
    window: Window = max(used, key=lambda w: w.points)
    k, now = session.index_of(taken.stop), expected_of(window, session.joint.scale)
    expanded = session.plan.after(session.joint, k, now).expanded
    at_last = session.plan.after(session.joint, k, now.longer(VERY_LONG)).expanded
    gain = np.max(expanded / session.wanted.by_parameter) / np.max(at_last / session.wanted.by_parameter)
    return Look("", window.points, window.left_out, expanded, float(gain), session.fit(k, window))


def _take(
    session: Session, measuring: Measuring, record: Record, taken: Sequence[Taken]
) -> tuple[Session, Measuring, tuple[str, ...]]:
    if not taken:
        session.restart()
        return session, measuring, ()
    session.take(*measuring.all(record, taken))
    return session, measuring, measuring.refused(record, taken) if session.reached else ()
