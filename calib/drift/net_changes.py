"""Test of net changes: whether S and Q have changed by more, over a week to four years, than is stated of their walks.

An estimate follows a steady drift that nobody stated window by window, each time within what a random walk may do. Its
net change is not within it: it grows with the time, that of a walk with the square root of the time. Under what is
stated, an estimate x_t by all windows up to t changes over a span L with the variance

    walk L + (u(rate) L)^2 + rate walk L^3 / 3 + P_(t-L) - P_t + 2 L P(x, rate)_(t-L)

because the error of x_t is independent of x_t; P are the variances of the estimates. Windows tell S (1 - r), with the
drift r of the reference. So S is tested as each reference shows it; which of them has moved is another question.

A change beyond a threshold is told: that of calib.drift.false_alarms for one test a day. Before, at WIDENS standard
deviations, S and the reference may each have walked by more than is stated, so that U covers the change whichever made
it (calib.estimate.statements.Widening). What was told stays so until `restart`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from calib.drift.drift import DAY_S, DriftVerdict
from calib.drift.false_alarms import false_alarm_threshold
from calib.estimate.estimate import Now
from calib.estimate.quantities import RATES, YEAR_DAYS, Quantity
from calib.estimate.statements import Widening
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import PARAMETERS, Array, own_channels
from calib.windows.record import Record

SHORTEST_DAYS, LONGEST_DAYS = 7, 1461
DENSE = 8  # of the days before, all of the newest are kept, and eight in each octave of age
WIDENS = 2.5  # standard deviations: with two equal walks and the error of a certificate, U covers a smaller change
# U = 2 u covers the errors 0 and d if u is d / 1.6; a tenth more is for what has come since the newest day.
SURELY = 1.4
SHARED = 0.3  # of the scale: what moves a parameter less cannot have changed it
PARTED = 0.5  # of a change: how much of it another reference shows tells which device has changed
NEAR = 0.25  # of a span: where the same span of another reference must begin
AGAIN = 2.0  # a change that was told is told again when it is so many times as large
MOST_REFERENCES = 8  # that are remembered
Makers = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceView:
    """S and Q as one reference shows them on a day, (12,) each: `value`, its variance, its covariance with its rate.

    What is stated of a change: the variance of its `walk` a day, that of its steady `rate`, and that of the walk of its
    rate. `makers`: what may have made a change of each parameter, by key: how far it moves for one unit of the change,
    and the variance a day of its own walk. `fixed`: the mount never turned, and the mean output is in the place of Q.
    """

    day: float
    value: Array
    variance: Array
    with_rate: Array
    walk: Array
    rate: Array
    rate_walk: Array
    makers: Sequence[Makers]
    fixed: bool


def shown(now: Now, record: Record, *, fixed: bool) -> ReferenceView:
    """S and Q as the reference of a record, its newest one, shows them. `fixed`: the mount never turns."""
    unknowns, scale = now.unknowns.all, now.unknowns.statements.scale
    jacobian = np.eye(12, len(now))
    makers = [{own.key: (1.0, own.a_day)} for own in unknowns[:12]]
    for quantity, moves in _drifts(now, record, fixed=fixed):
        k = now.index(quantity.key)
        jacobian[:9, k] = moves
        for own, moved in zip(makers[:9], np.abs(jacobian[:9, k]).tolist(), strict=True):
            if moved > SHARED * scale:
                own[quantity.key] = (1.0 / moved, unknowns[k].a_day)
    if fixed and np.isfinite(record.held_mps2).all():
        _lean(now, record, makers[9:])
    rates, half = [now.index(name) for name in RATES], jacobian @ now.factor
    a_day, u = (np.array([getattr(unknown, name) for unknown in unknowns]) for name in ("a_day", "u"))
    none = np.zeros(9)
    return ReferenceView(
        now.day, jacobian @ now.mean, np.sum(half**2, axis=1),
        np.append(none, np.sum(half[9:] * now.factor[rates], axis=1)),
        jacobian**2 @ a_day, np.append(none, u[rates] ** 2), np.append(none, a_day[rates]), makers, fixed,
    )  # fmt: skip


def _drifts(now: Now, record: Record, *, fixed: bool) -> Iterator[tuple[Quantity, Array]]:
    """The drift of each channel of a record's reference, and (9,) by what one unit of it moves S as it is shown."""
    S, ways = now.mean[:9].reshape(3, 3), record.pose.direction[:, : own_channels(record.channels)].T
    drifts = [q for q in now.quantities if q.kind.since_certificate and q.owner == record.reference and not q.centre]
    for quantity, way in zip(drifts, ways, strict=False):
        along = np.outer(way, way) if fixed or len(ways) > 1 else np.eye(3)  # a mount that turns brings it to all axes
        yield quantity, -(S @ along).ravel()


def _lean(now: Now, record: Record, makers: Sequence[dict[str, tuple[float, float]]]) -> None:
    """The mount may lean in place of a change of Q. No window shows it: all of the change is in Q, not half of it."""
    _, by = now.under_gravity(record)
    least = SHARED * now.unknowns.statements.scale * STANDARD_GRAVITY_MPS2
    for k, unknown in enumerate(now.unknowns.all):
        if "lean" in unknown.quantity.kind.loosened_by and not unknown.quantity.centre:
            for own, moved in zip(makers, np.abs(by[:, k]).tolist(), strict=True):
                if moved > least:
                    own[unknown.key] = (float(np.sqrt(2.0)) / moved, unknown.a_day)


@dataclass(frozen=True, slots=True, eq=False)
class _ReferenceCourse:
    """What a reference showed: `days` (K,), their numbers (K,), and value, variance, covariance with the rate
    (K, 3, 12)."""

    days: Array
    numbers: Array
    kept: Array

    @classmethod
    def begun(cls) -> _ReferenceCourse:
        return cls(np.empty(0), np.empty(0, dtype=np.int64), np.empty((0, 3, 12)))

    def after(self, now: ReferenceView) -> _ReferenceCourse:
        """With one more day; days that are close to others are dropped, the older the more."""
        if len(self.days) and now.day <= self.days[-1]:
            return self
        days, number = np.append(self.days, now.day), int(self.numbers[-1]) + 1 if len(self.numbers) else 0
        numbers = np.append(self.numbers, number)
        kept = np.concatenate([self.kept, np.array([[now.value, now.variance, now.with_rate]])])
        octave = np.maximum(np.frexp((number + 1 - numbers) / DENSE)[1] - 1, 0)
        keep = (numbers % (1 << octave) == 0) & (now.day - days <= LONGEST_DAYS)
        return _ReferenceCourse(days[keep], numbers[keep], kept[keep])

    def changes(self, now: ReferenceView) -> tuple[Array, Array] | None:
        """Sizes, standard deviations and first days (3, 12) of net changes: the most significant ones, and the largest
        of those beyond WIDENS standard deviations (0 where there is none)."""
        span = now.day - self.days
        long = (span >= SHORTEST_DAYS) & (span <= LONGEST_DAYS)
        if not long.any():
            return None
        span, kept = span[long, None], self.kept[long]
        size = now.value - kept[:, 0]
        own = np.maximum(kept[:, 1] - now.variance + 2.0 * span * kept[:, 2], 0.0)
        stated = now.walk * span + now.rate * span**2 + now.rate_walk * span**3 / 3.0
        sd = np.where(stated > 0.0, np.sqrt(stated + own), np.inf)
        found = np.array([size, sd, np.broadcast_to(self.days[long, None], size.shape)])
        far = np.where(np.abs(size) > WIDENS * sd, size, 0.0)
        best, most = (np.argmax(np.abs(by), axis=0) for by in (size / sd, far))
        every = np.arange(12)
        return found[:, best, every], np.where(far[most, every] != 0.0, found[:, most, every], 0.0)

    def change(self, p: int, since: float, now: ReferenceView) -> float | None:
        """The net change of one parameter since about that day; None where no such day is kept."""
        if not len(self.days):
            return None
        k = int(np.argmin(np.abs(self.days - since)))
        if abs(self.days[k] - since) > NEAR * (now.day - since):
            return None
        return float(now.value[p] - self.kept[k, 0, p])


@dataclass(frozen=True, slots=True)
class _ReportedChange:
    """A change that was told: of a parameter beside a reference, by `size`; `said` is the size when it was told."""

    reference: str
    parameter: int
    size: float
    said: float
    widening: Widening


class NetChanges:
    """The test of one sensor: `update` takes what its references show at the end of a day, `widened` is what S, Q and
    the references may have walked so far by more than is stated."""

    def __init__(self, false_alarms_a_year: float) -> None:
        """`false_alarms_a_year`: of all parameters beside all references together."""
        self._rate = false_alarms_a_year
        self._courses: dict[str, _ReferenceCourse] = {}
        self._told: dict[tuple[str, int], _ReportedChange] = {}
        self._past: list[Widening] = []  # of before a restart
        self._ended: list[int] = []  # parameters whose verdict ended with it
        self._fixed = True
        self.widened: list[Widening] = []

    @property
    def drifting(self) -> set[str]:
        """The parameters of which a change was told."""
        return {PARAMETERS[told.parameter] for told in self._told.values()}

    def threshold(self, references: int) -> float:
        """Of half the square of a change over its standard deviation; Q is the same beside all references."""
        tests = 9 * references + 3
        return false_alarm_threshold(self._rate / YEAR_DAYS / tests, SHORTEST_DAYS, LONGEST_DAYS)

    def update(self, by_reference: Mapping[str, ReferenceView]) -> list[DriftVerdict]:
        """Take what each reference shows. Returns the verdicts that are to be told."""
        if self._fixed and not all(now.fixed for now in by_reference.values()):
            self.restart()
            self._fixed = False
        news = [DriftVerdict(PARAMETERS[p]) for p in self._ended]
        self._ended, self.widened = [], []
        for k, (reference, now) in enumerate(by_reference.items()):
            course = self._courses.pop(reference, _ReferenceCourse.begun())
            if (found := course.changes(now)) is not None:
                for p in range(12 if k == 0 else 9):
                    best, most = (values[:, p].tolist() for values in found)
                    news += self._judged(reference, p, best, most, by_reference)
            self._courses[reference] = course.after(now)
        self._courses = dict(list(self._courses.items())[-MOST_REFERENCES:])
        self.widened += [*self._past, *(told.widening for told in self._told.values())]
        return news

    def _judged(
        self,
        reference: str,
        p: int,
        best: Sequence[float],
        most: Sequence[float],
        by_reference: Mapping[str, ReferenceView],
    ) -> list[DriftVerdict]:
        before, now = self._told.get((reference, p)), by_reference[reference]
        threshold, statistic = self.threshold(len(by_reference)), 0.5 * (best[0] / best[1]) ** 2
        size, sd, since = most
        if abs(size) <= (0.0 if before is None else abs(before.size)):
            return []
        if before is None and statistic <= threshold:
            if len(now.makers[p]) > 1:
                self.widened.append(_widening(now.makers[p], size, since, now.day))
            return []
        makers, cause = self._cause(reference, p, size, since, by_reference)
        told = _ReportedChange(reference, p, size, abs(size), _widening(makers, size, since, now.day))
        if before is not None and abs(size) < AGAIN * before.said:
            self._told[reference, p] = replace(told, said=before.said)
            return []
        self._told[reference, p] = told
        days = now.day - since
        reason = (
            f"{PARAMETERS[p]} has changed by {size:+.3g} in {days:.0f} days; what is stated allows {sd:.2g} (standard "
            f"deviation); the statistic {statistic:.1f} is above its threshold {threshold:.1f}; cause: {cause}"
        )
        return [
            DriftVerdict(
                PARAMETERS[p],
                "drifting",
                change=size,
                rate=size / days,
                onset_s=since * DAY_S,
                statistic=statistic,
                threshold=threshold,
                reason=reason,
            )
        ]

    def _cause(
        self, reference: str, p: int, size: float, since: float, by_reference: Mapping[str, ReferenceView]
    ) -> tuple[Makers, str]:
        """What may have made a change, and a sentence on it."""
        makers = by_reference[reference].makers[p]
        (own, *others) = makers
        if p >= 9:
            return makers, "offset, or lean of the mount (the data cannot tell which)" if others else "offset"
        if not others:
            return makers, "sensor, or its mounting beside the reference"
        for other, now in by_reference.items():
            beside = (
                self._courses.get(other, _ReferenceCourse.begun()).change(p, since, now) if other != reference else None
            )
            if beside is not None and beside * np.sign(size) > PARTED * abs(size):
                return {own: makers[own]}, f"sensor, because {other} shows the same"
            if beside is not None:
                return {key: makers[key] for key in others}, (
                    f"reference {reference}, because {other} does not show it; have it calibrated"
                )
        return makers, (
            "sensor or reference (the data cannot tell which); U covers either until gravity, a second reference or an "
            "operator tells. Have the reference calibrated"
        )

    def restart(self) -> None:
        """Forget what was shown, because S or Q, or what is stated, was replaced. U stays as wide as it is."""
        self._past += [told.widening for told in self._told.values()]
        self._ended = sorted({*self._ended, *(told.parameter for told in self._told.values())})
        self._courses, self._told = {}, {}

    # --- state

    def snapshot(self) -> dict[str, Any]:
        """The complete state, for `load`; bit for bit."""
        return {
            "courses": {
                reference: {"days": own.days, "numbers": own.numbers, "kept": own.kept}
                for reference, own in self._courses.items()
            },
            "told": [asdict(told) for told in self._told.values()],
            "past": [asdict(widening) for widening in self._past],
            "ended": list(self._ended),
            "fixed": self._fixed,
            "widened": [asdict(widening) for widening in self.widened],
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from the state that `snapshot` returned."""
        self._courses = {reference: _ReferenceCourse(**own) for reference, own in state["courses"].items()}
        loaded = (_ReportedChange(**{**told, "widening": Widening(**told["widening"])}) for told in state["told"])
        self._told = {(told.reference, told.parameter): told for told in loaded}
        self._past = [Widening(**widening) for widening in state["past"]]
        self._ended, self._fixed = list(state["ended"]), state["fixed"]
        self.widened = [Widening(**widening) for widening in state["widened"]]


def _widening(makers: Makers, size: float, since: float, until: float) -> Widening:
    """What makers may have walked besides what is stated: where there are several, the estimate gives each a half."""
    share = abs(size) / SURELY * (float(np.sqrt(0.5)) if len(makers) > 1 else 1.0)
    variance = {key: (share * moves) ** 2 - a_day * (until - since) for key, (moves, a_day) in makers.items()}
    return Widening(since, until, {key: float(np.sqrt(own)) for key, own in variance.items() if own > 0.0})
