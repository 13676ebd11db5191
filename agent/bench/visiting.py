"""What the samples of a visit show so far: the clamp, U, and how long the visit takes until U is as wanted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.bench.aside import Aside
from agent.bench.measuring import Measuring, Record, StopInterval
from calib.estimate.quantities import LAG, S_AND_Q
from calib.model import Array, Window
from calib.recorded.outcome import Outcome
from calib.visit.clamping import Clamping, clamping
from calib.visit.next_stop import COVERAGE_FACTOR, MAIN, WantedUncertainty

# Sources of the budget that shrink as more is measured: their variance goes with the inverse of the time. All others
# stay, such as the reference, its rotation, and what was known before of the transverse sensitivities.
SHRINKING = (
    "type A", "slopes between windows", "lag between windows", "correction for the reference's noise",
    "response between bands", "response over frequency", LAG.source,
)  # fmt: skip
KNOWN_BEFORE = "prior of S and Q"


@dataclass(frozen=True, slots=True, eq=False)
class Ahead:
    """U (k = 2) of S relative to the main sensitivities, now and later. `now`, `at_last` (9,): U after any time.

    `needed_s`: from the beginning of the visit until all U are as wanted; inf where that never happens. `because` is
    the largest source of what is left then.
    """

    now: Array
    at_last: Array
    needed_s: float
    because: str


@dataclass(frozen=True, slots=True, eq=False)
class VisitLook:
    """A look at a visit: the clamp, None where too little was seen; U, None where the result would be refused."""

    clamp: Clamping | None
    ahead: Ahead | None
    reasons: tuple[str, ...]


def ahead(outcome: Outcome, measured_s: float, wanted: WantedUncertainty) -> Ahead | None:
    """What an outcome tells of a longer visit; None where it was refused."""
    if outcome.calibration is None:
        return None
    names = [q.name for q in S_AND_Q[:9]]
    main = np.repeat(np.abs(np.diag(outcome.calibration.sensitivity)), 3)
    variance = {
        source: (np.array([float(u[name]) for name in names]) / main) ** 2
        for source, u in outcome.more["budget"].items()
    }
    none = np.zeros(9)
    shrinks = np.sum([v for source, v in variance.items() if source in SHRINKING] or [none], axis=0)
    before = variance.get(KNOWN_BEFORE, none)
    # What was known before of a main sensitivity counts less and less; of a transverse one it is all that tells it from
    # the rotation of the reference.
    fades = np.where(MAIN, before, 0.0)
    stays = {source: v for source, v in variance.items() if source not in (*SHRINKING, KNOWN_BEFORE)}
    stays[KNOWN_BEFORE] = before - fades
    left = np.sum(list(stays.values()), axis=0)
    now, at_last = (COVERAGE_FACTOR * np.sqrt(v) for v in (left + shrinks + fades, left))
    limit = wanted.by_parameter
    asked = np.isfinite(limit)
    room = (limit / COVERAGE_FACTOR) ** 2 - left
    worst = int(np.argmax(at_last / limit))
    because = max(stays, key=lambda source: float(stays[source][worst]))
    if np.any(room <= 0.0):
        return Ahead(now, at_last, np.inf, because)
    # shrinks r + fades r^2 = room, with r the time measured over the time needed
    a, b, c = shrinks[asked], fades[asked], room[asked]
    ratio = 2.0 * c / (a + np.sqrt(a**2 + 4.0 * b * c) + np.finfo(float).tiny)
    return Ahead(now, at_last, measured_s / float(ratio.min()), because)


def look_at(measuring: Measuring, wanted: WantedUncertainty, record: Record, taken: StopInterval) -> VisitLook:
    """A look at the samples of a visit so far."""
    windows = measuring.newest(record, taken)
    if not any(w.used for w in windows):
        return VisitLook(_clamp(measuring, windows), None, _refusal_reasons(windows))
    clamp = _clamp(measuring, measuring.without_lag(record, [taken]))
    if clamp is not None and clamp.drowned:  # an adjustment would take long, and tell nothing
        return VisitLook(clamp, None, ())
    outcome = measuring.outcome(record, [taken])
    return VisitLook(clamp, ahead(outcome, taken.stop_s - taken.start_s, wanted), outcome.reasons)


def _refusal_reasons(windows: Sequence[Window]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(w.reason for w in windows if w.reason)) or ("too few samples",)


def _clamp(measuring: Measuring, windows: Sequence[Window]) -> Clamping | None:
    known = measuring.priors
    assert known.parameters is not None
    assert known.covariance is not None
    return clamping(windows, known.parameters, known.covariance, known.rotation_rad)


@dataclass(frozen=True, slots=True)
class Visiting:
    """The measuring of one visit, which computes aside."""

    measuring: Measuring
    wanted: WantedUncertainty
    aside: Aside

    def look(self, record: Record, taken: StopInterval) -> VisitLook:
        """A look at the samples so far."""
        return self.aside.call(look_at, self.measuring, self.wanted, record, taken)
