"""The computing of a session, aside from the process that reads the devices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.bench.aside import Aside
from agent.bench.measuring import Measuring, Record, StopInterval
from agent.bench.session import BenchSession, Outlook, StopFit, expected_of
from calib.model import Array, Window
from calib.visit.next_stop import Suggestion

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
    fit: StopFit | None = None


class Thinking:
    """A session and its measuring. Each method computes aside, in the other process."""

    def __init__(self, session: BenchSession, measuring: Measuring, aside: Aside) -> None:
        self.session, self.measuring, self._aside = session, measuring, aside

    def next_stop(self) -> tuple[Suggestion, Outlook]:
        """The stop that gains most, and how far it is to what is wanted."""
        return self._aside.call(_next_stop, self.session)

    def look(self, record: Record, taken: StopInterval) -> Look:
        """Look at the stop that is being taken."""
        return self._aside.call(_look, self.session, self.measuring, record, taken)

    def take(self, record: Record, taken: Sequence[StopInterval]) -> tuple[str, ...]:
        """Adjust all stops; none at all begins anew. Where all is as wanted: why the result would be refused."""
        found = self._aside.call(_take, self.session, self.measuring, record, taken)
        self.session, self.measuring, refused = found
        return refused


def _next_stop(session: BenchSession) -> tuple[Suggestion, Outlook]:
    return session.suggestion(), session.outlook()


def _look(session: BenchSession, measuring: Measuring, record: Record, taken: StopInterval) -> Look:
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
    session: BenchSession, measuring: Measuring, record: Record, taken: Sequence[StopInterval]
) -> tuple[BenchSession, Measuring, tuple[str, ...]]:
    if not taken:
        session.restart()
        return session, measuring, ()
    session.take(*measuring.windows_and_priors(record, taken))
    return session, measuring, measuring.refusal_reasons(record, taken) if session.reached else ()
