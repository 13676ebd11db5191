"""The state of one sensor on-line: records of windows, statements, and what they say of S and Q now.

A window is predicted, and appended to the newest epoch, without a look at the others. The whole is solved anew
(calib.estimate.estimate) where a statement changed, where the estimate has moved so far that windows must be linearised
again, and where old records are merged (calib.state.thinning): at the end of each day of the data, and within a day
after each 48 windows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from typing import Any, Self

import numpy as np

from calib.drift.net_changes import ReferenceView, shown
from calib.estimate.correction import Law
from calib.estimate.determined import Flags, determined
from calib.estimate.estimate import Estimate, Now, Then, estimate
from calib.estimate.innovation import Innovation
from calib.estimate.nuisances import Priors
from calib.estimate.quantities import (
    ALL_RATES,
    KINDS,
    LAG,
    OFFSET_TEMPERATURE,
    PRIORS,
    S_AND_Q,
    SENSITIVITY_PER_K,
    Quantity,
    offset_temperature,
)
from calib.estimate.reference_share import ReferenceShare, share_in
from calib.estimate.response_told import ResponseTold
from calib.estimate.statements import DOUBT, Dated, Statements, Step, Widening
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Array, Calibration, scale_of
from calib.signal.response import Response
from calib.state.dating import Date, date_of_change, stated_date
from calib.state.over_frequency import SEVERAL, OverFrequency, changed
from calib.state.past import Past, StatedChange, epoch_days
from calib.state.sources import Sources
from calib.state.thinning import NEWEST, thinned
from calib.windows.never_turned import never_turned
from calib.windows.record import Record, together

DATED = ", calibrated "  # in the identity of a reference whose certificate states its date
BODY_DAYS = 1.0 / 24.0  # the time by which the body of a sensor and its reference may be behind a thermometer
STEADY = np.zeros(12)  # rates of S and Q
METHOD = "3 (recursive adjustment)"
MOST_POSITIONS, MOST_REFERENCES = 48, 8  # whose records are kept
OF_REFERENCES = [  # what belongs to a place is as it is stated now, whichever reference stands there
    s.name
    for kind in KINDS.values()
    if kind.of_reference and not kind.of_place
    for s in kind.statements
    if s.name in PRIORS
]
STILL = 1e-3  # of the windows that move in the direction in which most do: so few are rounding errors, and small turns
FIRST = 0  # the place of the first reference
MOVED_U = 0.3  # standard uncertainties: what is not linear within so little is far below u
Jump = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Mounted:
    """What is known of a reference by its identity: the place where it is or was mounted, the sensitivity and the day
    of its certificate (None if no date is stated), and what is stated of it (names of OF_REFERENCES)."""

    place: int
    sensitivity: float
    certified_day: float | None
    stated: Mapping[str, float]


class State:
    """S, Q and all else of one sensor. The methods under "reading" do not change it, those under "changing" do.

    `mean`, `standard_uncertainty` (12,): what was known of S, Q beforehand, in output units; `fixed` mounts do not
    turn. Days count from any origin. `check`: the priors beside further references, which are mounted all the time as
    the first one is. The first has place 0, the next one has place 1; what depends on the reference is of the one at
    the `place` that is named. `band_hz`: the ends in Hz of the motion that is used; None: windows settle it.
    """

    def __init__(
        self,
        mean: Array,
        standard_uncertainty: Array,
        priors: Priors,
        wander: Wander,
        temperature: TemperatureModel,
        *,
        fixed: bool,
        check: Sequence[Priors] = (),
        band_hz: tuple[float, float] | None = None,
    ) -> None:
        self._mean, self._u = np.array(mean, dtype=float), np.array(standard_uncertainty, dtype=float)
        self._priors, self._wander, self._temperature = [priors, *check], wander, temperature
        self._body: tuple[float, float] | None = None  # the day, and the temperature that a slow body has then
        self._zero_degc: float | None = None  # of S and Q, where the first window settles it
        self._fixed = fixed
        self.scale = scale_of(self._mean)
        self._present = [""] * len(self._priors)  # the references by place
        self._met: dict[str, Mounted] = {}  # every reference that was connected, last use last
        self._used: list[str] = []  # the references of windows; the newest window's is the last
        self._records: list[Record] = []
        self._steps: list[Step] = []
        self._dated: list[Dated] = []
        self._widened: list[Widening] = []
        self._band_hz = band_hz
        self._over = OverFrequency().stating(band_hz)
        self._held_mps2: Array | None = None  # mean input acceleration of a mount that never turned so far
        self._now = estimate([], self.statements).now
        self._read: tuple[Now, str, Array, Array] | None = None  # what `_values` found, beside which reference
        self._stated_then: Any = None  # what was stated when a loaded state was kept, if that is another now
        self._newest_day: int | None = None  # of the data; None before any window
        self.windows, self._merged_at = 0, 0  # windows that were taken: until now, and when records were merged last

    # --- reading

    @property
    def statements(self) -> Statements:
        """All that is stated."""
        now = self._priors[0]
        priors = {"": self._over.stated(now)}
        for reference, met in self._met.items():
            own = self._priors[met.place] if reference in self._present else now.with_values(met.stated)
            priors[reference] = self._over.stated(own)
        certified = {r: met.certified_day for r, met in self._met.items() if met.certified_day is not None}
        places = {reference: met.place for reference, met in self._met.items()}
        return Statements(
            self._mean, self._u, priors, self._wander, self._over_temperature, places, certified, tuple(self._steps),
            tuple(self._widened), tuple(self._dated), self._held_mps2 if self._mean_is_held else None,
        )  # fmt: skip

    @property
    def _over_temperature(self) -> TemperatureModel:
        """What is stated of the dependence on temperature, about the temperature that the first window settled."""
        if not self._temperature.settles or self._zero_degc is None:
            return self._temperature
        return replace(self._temperature, reference_degc=self._zero_degc)

    def estimate(self, beside: Sequence[Record] = (), also: Sequence[float] = ()) -> Estimate:
        """The whole solved anew, the past as well; `beside`, `also`: as of `calib.estimate.estimate.estimate`."""
        days = [max(r.day for r in self._records)] if self._records else []
        days += [step.day for step in self._steps if days and step.day > days[0]]
        start = self._now if self._records else None
        return estimate(self._records, self.statements, start=start, also=[*days, *also], beside=beside)

    def with_body(self, record: Record) -> Record:
        """A window with the temperature of a body that follows the told one late (Record.behind_k)."""
        if self._body is None or not record.tells_temperature:
            return record
        day, degc = self._body
        kept = float(np.exp(-abs(record.day - day) / BODY_DAYS))
        return replace(record, behind_k=kept * (degc - record.temperature_degc))

    def reference(self, place: int = FIRST) -> str:
        """The reference that is at a place now."""
        return self._present[place]

    def innovation(self, record: Record, *, at_its_lag: bool = False) -> Innovation:
        """What the window says against the state at its time.

        `at_its_lag`: linearised at the lag that was taken out of the window, not at the state's, which may be too far.
        """
        return self._against(record, at_its_lag)[0]

    def with_window(self, record: Record, *, at_its_lag: bool = False) -> tuple[Innovation, Self]:
        """What the window says against the state at its time (see `innovation`), and a copy that has taken it."""
        told, taken = self.tried(record, at_its_lag=at_its_lag)
        return told, taken()

    def tried(self, record: Record, *, at_its_lag: bool = False) -> tuple[Innovation, Callable[[], Self]]:
        """As `with_window`, but the copy takes the window, which may mean to solve everything anew, when it is asked
        for; it can be asked for once."""
        told, trial, used, ahead, rows = self._against(record, at_its_lag)
        return told, partial(trial._take, used, ahead, rows)

    def lag_with(self, record: Record, place: int = FIRST) -> float:
        """The lag once a window of the reference at a place is taken, by its equations linearised at the lag that was
        taken out of it."""
        _, trial, record, ahead, rows = self._against(record, at_its_lag=True)
        trial._now = ahead.with_window(record, rows)
        return trial.lag_s(place)

    def _against(self, record: Record, at_its_lag: bool) -> tuple[Innovation, Self, Record, Now, Array]:
        trial = self.copy()
        record, ahead = trial._know(record)
        at = None
        if at_its_lag:
            at = ahead.mean.copy()
            if (k := ahead.unknowns.at.get(_lag_of(record.reference))) is not None:
                at[k] = record.lag_s
        rows = ahead.rows(trial._directed(record), at)
        return ahead.says(rows), trial, record, ahead, rows

    @property
    def _mean_is_held(self) -> bool:
        """Whether the mean output of a fixed mount stands in the place of Q."""
        return self._fixed and self._held_mps2 is not None

    def _directed(self, record: Record) -> Record:
        """A window with the directions that it excites, as all windows until now tell them."""
        return together([*self._records, record], fixed=self._mean_is_held)[-1] if record.planar else record

    def _key(self, name: str, place: int) -> str:
        """The key of an unknown of the sensor, its mount, or the reference at a place by its name or its key."""
        of = [f"{name} of {owner}" for owner in (self.reference(place), f"place {place}") if owner]
        return next((key for key in (*of, name) if key in self._now), name)

    def lag_s(self, place: int = FIRST) -> float:
        """By how much the sensor is later than the reference; as stated before any window told."""
        key = _lag_of(self.reference(place))
        if key in self._now:
            return float(self._now.mean[self._now.index(key)])
        return self._priors[place].of(LAG.mean)

    def response(self, place: int = FIRST) -> Response:
        """The response of the sensor over that of the reference, to take out of its next window."""
        reference = self.reference(place)
        before = (record.response for record in reversed(self._records) if record.reference == reference)
        return self._over.response(self._now, reference, next(before, ()))

    def response_is_known(self, place: int = FIRST) -> bool:
        """Whether windows have told it: one more cannot change it much."""
        return self._over.is_known(self._now, self.reference(place))

    def response_is(self, taken: Response, place: int = FIRST) -> bool:
        """Whether it is the one that was taken out of a window, but for a part of its uncertainty."""
        return self._over.is_taken_out(taken, self._now, self.reference(place))

    def response_change(self, since: State, place: int = FIRST) -> tuple[float, float]:
        """The upper end of the motion in Hz, and by how much S is larger there than it was, relative."""
        to_hz = self._over.motion_hz[1] if self._over.motion_hz else self._over.first_hz
        now, before = (one._over.log_h(one._now, self.reference(place), to_hz) for one in (self, since))
        return to_hz, float(np.expm1(now - before))

    def has_another_response(self, than: State, place: int = FIRST) -> bool:
        """Whether the response beside the reference is surely another than in an earlier state."""
        return self._over.differs(self._now, than._now, self.reference(place))

    def response_over_frequency(self, place: int = FIRST) -> ResponseTold | None:
        """What is known of it, by frequency; None where it is no unknown."""
        return self._over.response_over_frequency(
            self._now, self.reference(place), self._priors[0], self.coverage_factor
        )

    @property
    def reference_frequency_hz(self) -> float:
        """The frequency at which S holds; 0 if nothing moved yet."""
        return self._over.reference_hz(self._priors[0])

    @property
    def motion_to_hz(self) -> float:
        """Upper end of the motion that is used; inf before a window told a band that is wide enough for a response."""
        return self._over.to_hz

    @property
    def unexcited(self) -> Array:
        """(k, 3) directions in the sensor's frame, orthonormal, in which no window moved."""
        moved = np.sum([r.excited for r in together(self._records, fixed=self._mean_is_held)], axis=0)
        size, ways = np.linalg.eigh(moved) if self._records else (np.zeros(3), np.eye(3))
        return np.asarray(ways.T[size <= STILL * size[-1]])

    def settled_since(self, earlier: State) -> str:
        """For the operator: which band and frequency several windows settled since an earlier state; or ""."""
        return self._over.news(earlier._over, self._priors[0])

    def _determined(self, mean: Array, covariance: Array) -> Flags:
        return determined(mean, np.sqrt(covariance.diagonal()), self._u, np.ones(12, dtype=bool))

    def result(self, place: int = FIRST) -> Calibration:
        """S and Q as they are; where a parameter is not determined, still what was known beforehand of it.

        U contains what the response beside the reference at a place leaves open.
        """
        mean, covariance = self._parameters(place)
        freedom = self._now.noise.degrees_of_freedom or np.inf
        told = self._determined(mean, covariance)
        return Calibration(mean[:9].reshape(3, 3), mean[9:], covariance, told, freedom, METHOD)

    def covariance(self, place: int = FIRST) -> Array:
        """(12, 12) that of `result`."""
        return self._parameters(place)[1]

    @property
    def coverage_factor(self) -> float:
        """For about 95 % coverage."""
        return self._now.coverage_factor

    def _parameters(self, place: int) -> tuple[Array, Array]:
        """S and Q (12,) and their covariance."""
        mean, factor = self._values(place)
        return mean[:12], np.asarray(factor[:12] @ factor[:12].T)

    def _values(self, place: int) -> tuple[Array, Array]:
        """All unknowns (N,) and a factor of their covariance, with what the response over frequency adds to it; Q where
        the mean output of a fixed mount stands."""
        reference = self.reference(place)
        if self._read is None or self._read[0] is not self._now or self._read[1] != reference:
            self._read = self._now, reference, *self._values_of(self._now, reference)
        return self._read[2], self._read[3]

    def _values_of(self, now: Now, reference: str) -> tuple[Array, Array]:
        mean, factor = now.mean.copy(), self._over.factor(now, reference, self._priors[0]).copy()
        if (under_gravity := self._under_gravity(now)) is not None:
            more, by = under_gravity
            mean[9:12] -= more
            factor[9:12] -= by @ factor
            if self._varies(now):  # the first power of the mean output contains that of S
                own, of_S = (
                    [now.index(name) for name in names] for names in (offset_temperature(1), SENSITIVITY_PER_K)
                )
                mean[own] -= by[:, :9] @ mean[of_S]
                factor[own] -= by[:, :9] @ factor[of_S]
        return mean, factor

    @staticmethod
    def _varies(now: Now) -> bool:
        """Whether S is estimated as a function of the temperature."""
        return SENSITIVITY_PER_K[0] in now

    def _under_gravity(self, now: Now) -> tuple[Array, Array] | None:
        """By what the mean output of a fixed mount is more than Q (3,), with the derivatives (3, N); None of another
        mount."""
        record = None
        for record in (r for r in reversed(self._records) if np.isfinite(r.held_mps2).all()):
            if record.day <= now.day:
                break
        if not self._fixed or self._held_mps2 is None or record is None:
            return None
        under, by = now.under_gravity(record)
        S, away = now.mean[:9].reshape(3, 3), record.held_mps2 - self._held_mps2
        return under - S @ away, by - np.kron(np.eye(3), away) @ np.eye(9, len(now))

    def law(self, day: float | None = None, place: int = FIRST) -> Law:
        """S and Q over temperature, with all that their covariance knows of each other; `day`: wandered on until it."""
        if day is not None:
            waited = self.copy()
            waited._now = self._now.passed_to(day)
            return waited.law(place=place)
        return self._law(self._now, *self._values(place))

    def _law(self, now: Now, mean: Array, factor: Array) -> Law:
        temperature = self._over_temperature
        of_S = temperature.of_sensitivity(self.scale) if self._varies(now) else []
        own = [quantity.key for quantity, _ in (*temperature.of_offset(self.scale), *of_S)]
        chosen = [*range(12), *map(now.index, own)]
        mean, factor = mean[chosen], factor[chosen]
        covariance, (low, high) = factor @ factor.T, self.temperature_range_degc
        told, u_beyond = self._determined(mean[:12], covariance[:12, :12]), temperature.u_offset_mps2[1] * self.scale
        return Law(
            mean,
            covariance,
            temperature.offset_order,
            bool(of_S),
            temperature.reference_degc,
            low,
            high,
            u_beyond,
            told,
        )

    @property
    def _moving_steps(self) -> list[Step]:
        """Those of more than a lag: S and Q may have moved."""
        return [step for step in self._steps if any(not key.startswith("lag") for key in step.u)]

    def past(self) -> Past:
        """S and Q of all epochs by all windows; no epoch before any window."""
        if not self._records:
            return Past(np.zeros(0), (), (), (), np.inf, self.coverage_factor)
        begin, counts = min(r.days[0] for r in self._records), Counter[float]()
        for record in self._records:
            counts[record.day] += record.windows
        stated: dict[float, dict[str, float]] = {}
        for step in self._moving_steps:
            if step.day > min(counts):
                own = stated.setdefault(step.day, {})
                own |= {key: float(np.hypot(u, own.get(key, 0.0))) for key, u in step.u.items()}
        whole, laws, changes = self.estimate(also=epoch_days(counts, stated)), list[Law](), list[StatedChange]()
        days = whole.days.tolist()
        for then, after in zip(whole.past(), [np.inf, *reversed(days)], strict=False):
            laws.append(self._law(then.now, *self._values_of(then.now, self.reference())))
            if after in stated:
                dated = self._dated_by(whole, then, after, [begin, *stated, days[-1]])
                changes.append(StatedChange(after, stated[after], *self._change_of(then), dated))
        windows = [counts[day] for day in days]
        return Past(whole.days, laws[::-1], windows, changes[::-1], begin, self.coverage_factor)

    def _dated_by(self, whole: Estimate, then: Then, day: float, known: Sequence[float]) -> Callable[[], Date]:
        """What tells when the change on a day, just after `then`, came: if windows showed it, all of them, between the
        changes before and after it. `known`: the days of the first window, of all changes, and of the last window."""
        keys = {key for step in self._steps if step.day == day for key in step.u if key in then.now}
        kinds = [then.now.quantities[then.now.index(key)].kind for key in keys]
        if all("remount" in kind.loosened_by for kind in kinds) or any(own.day == day for own in self._dated):
            return partial(stated_date, whole.records, day)
        begin, end = max(d for d in known if d < day), min((d for d in known if d > day), default=day)
        return cache(partial(date_of_change, whole, then, day, begin, end))

    def budget(self, whole: Estimate | None = None, place: int = FIRST) -> Sources:
        """What makes U of S and Q (see `result`) by a solution of the whole; None: it is solved anew."""
        whole = whole or self.estimate()
        now, by = whole.now, np.eye(12, len(whole.unknowns))
        if (under_gravity := self._under_gravity(now)) is not None:
            by[9:] -= under_gravity[1]
        beside = self._over.budget(now, self.reference(place), self._priors[0], by)
        return Sources.of(whole.budget(by) | beside, now.noise.degrees_of_freedom or np.inf, now.coverage_factor)

    def _change_of(self, then: Then) -> tuple[Array, Array]:
        """By how much S and Q changed (12,) from an epoch to the next one, and the standard uncertainties."""
        whole = np.column_stack([then.moved, then.moved_factor])
        moved = whole[:12].copy()
        if (under_gravity := self._under_gravity(then.now)) is not None:
            moved[9:] -= under_gravity[1] @ whole
        return moved[:, 0], np.linalg.norm(moved[:, 1:], axis=1)

    def quantity(self, name: str, place: int = FIRST) -> tuple[float, float]:
        """(value, u) of an unknown of the sensor, its mount or the reference at a place.

        Raises KeyError where it is none of these.
        """
        now, key = self._now, self._key(name, place)
        own = [now.index(key)]
        quantity = now.unknowns.all[own[0]].quantity
        if quantity.kind.since_certificate:  # the value at the beginning, and the walk since then
            own.append(now.index(replace(quantity, centre=True).key))
        mean, factor = now.mean, now.factor
        if quantity.kind is OFFSET_TEMPERATURE and self._varies(now):
            mean, factor = self._values(place)
        return float(mean[own].sum()), float(np.linalg.norm(factor[own].sum(axis=0)))

    @property
    def residual_sd(self) -> Array:
        """(3,) of single points in the newest window, output unit; NaN before any."""
        return self._records[-1].noise.copy() if self._records else np.full(3, np.nan)

    @property
    def reference_temperature_degc(self) -> float:
        """To which S and Q refer."""
        return self._over_temperature.reference_degc

    @property
    def quantities(self) -> list[Quantity]:
        """All unknowns, also those of references that are away."""
        return self._now.quantities

    def present(self, place: int = FIRST) -> list[Quantity]:
        """All unknowns of the sensor, its mount and the reference at a place."""
        owners = "", self.reference(place), f"place {place}"
        return [q for q in self._now.quantities if q.owner in owners and not q.centre]

    def names(self, place: int = FIRST) -> list[str]:
        """Those of `present`."""
        return [quantity.name for quantity in self.present(place)]

    @property
    def references(self) -> list[str]:
        """References to whose errors S and Q owe their values; the newest window's is the last."""
        return list(self._used)

    def shares(self, place: int = FIRST) -> list[ReferenceShare]:
        """What S and Q (see `result`) owe to the errors of each reference; that of the newest window is the last."""
        factor = self._values(place)[1][:12]
        return [share_in(self._now, factor, r, self._met[r].sensitivity if r in self._met else 1.0) for r in self._used]

    @property
    def temperature_range_degc(self) -> tuple[float, float]:
        """Lowest and highest temperature of a window taken; NaN before any."""
        return self._now.seen_degc

    @property
    def day(self) -> float | None:
        """The day of the newest window; None before any."""
        return max((r.days[1] for r in self._records), default=None)

    @property
    def chi2(self) -> float:
        """The sum of squares of all rows: windows, walks, steps and priors."""
        return self._now.chi2

    def chi2_beside(self, records: Sequence[Record]) -> float:
        """That of this state alone with the noise of these records pooled in: what `after` is compared with."""
        return self.estimate(beside=records).chi2

    def changes(
        self,
        standard_uncertainty: Array,
        tilt_rad: float = 0.0,
        *,
        place: int = FIRST,
        u_rate: Array = STEADY,
        line: bool = False,
        another_filter: float = 0.0,
    ) -> dict[str, float]:
        """Standard uncertainties of a step, by key: of S and Q (12,), or of all `quantities` (N,), and of the tilt of a
        fixed mount.

        `u_rate` (12,): S and Q may drift by as much more a day. Of the reference at a place tell `line`: a device or
        its line may have begun anew, which makes the lag another; and `another_filter`: the response over frequency may
        be another, so that S, which holds at one frequency, changes by about this share of itself; inf if nobody knows
        by how much.
        """
        u = {q.key: abs(float(s)) for q, s in zip(self.quantities, standard_uncertainty, strict=False) if s}
        u |= {ALL_RATES[p]: abs(float(u_rate[p])) for p in np.flatnonzero(u_rate).tolist()}
        reference = self.reference(place)
        stated = self.statements.of(reference)
        for quantity in self.quantities:
            of_it = () if quantity.centre else quantity.kind.loosened_by
            if "lean" in of_it and self._fixed and tilt_rad:
                u[quantity.key] = tilt_rad
            elif quantity.owner == reference and line and "line" in of_it:
                u[quantity.key] = stated.of(quantity.kind.prior)
            elif quantity.owner == reference and another_filter and "filter" in of_it:
                prior = stated.of(quantity.kind.prior)
                of_S = self._over.prior_of(self._now, reference, self.reference_frequency_hz, prior)
                u[quantity.key] = prior * min(1.0, another_filter / of_S) if of_S else prior
        return u

    def after(self, records: Sequence[Record], u: Jump) -> Self:
        """A copy that has taken these windows after a step just before the first of them (see `changes`)."""
        trial = self.copy()
        trial.take_also(records, [Step(float(np.nextafter(records[0].day, -np.inf)), dict(u))])
        return trial

    def stating(self, **stated: float) -> Self:
        """A copy beside whose references other priors are stated, by the names of calib.estimate.nuisances.Priors."""
        other = self.copy()
        other._priors = [priors.with_values(stated) for priors in self._priors]
        other.solve()
        return other

    def change_on(self, day: float, u: Jump) -> tuple[Array, Array]:
        """By how much S and Q changed (12,), and the covariance (12, 12), if unknowns stepped just before the windows
        of a day (see `changes`), and not since then. No change where no window is older."""
        begin, trial = float(np.nextafter(day, -np.inf)), self.copy()
        others = [step for step in self._steps if step.day < begin or not step.u.keys() & u.keys()]
        trial._steps = sorted([*others, Step(begin, dict(u))], key=lambda step: step.day)
        for then in trial.estimate().past():
            if then.now.day < begin:
                return then.moved[:12], np.asarray(then.moved_factor[:12] @ then.moved_factor[:12].T)
        return np.zeros(12), np.eye(12)

    def copy(self) -> Self:
        """An independent copy, to try windows on."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        other._present, other._met, other._used = list(self._present), dict(self._met), list(self._used)
        other._records, other._steps, other._dated = list(self._records), list(self._steps), list(self._dated)
        return other

    def shown(self) -> dict[str, ReferenceView]:
        """S and Q as each present reference shows them; of references with a window."""
        newest = {r.reference: r for r in self._records if r.reference in self._present}
        return {reference: shown(self._now, record, fixed=self._fixed) for reference, record in newest.items()}

    def begins_day(self, day: float) -> bool:
        """Whether a window on this day is the first one of a day of the data."""
        return self._newest_day is not None and np.floor(day) > self._newest_day

    # --- changing

    def update(self, record: Record) -> None:
        """Take a window."""
        self.merge_old(record.day)
        record = self.with_body(record)
        record, ahead = self._know(record)
        self._take(record, ahead, ahead.rows(self._directed(record)))

    def merge_old(self, day: float) -> Estimate | None:
        """Before a window on this day: old records are merged and the whole is solved anew, where a day of the data is
        over or so many windows came that the state would grow. Returns the solution; None where neither is so."""
        if not self.begins_day(day) and self.windows - self._merged_at < NEWEST:
            return None
        self._merged_at = self.windows
        self._newest_day = None if self._newest_day is None else max(self._newest_day, int(np.floor(day)))
        cuts = [step.day for step in self._moving_steps]
        records = together(self._records, fixed=self._mean_is_held)
        self._records = _newest(thinned(records, day, self._now.mean[:9].reshape(3, 3), cuts))
        return self.solve()

    def solve(self) -> Estimate:
        """Everything anew, from the records and the statements."""
        whole = self.estimate()
        self._now = whole.now
        return whole

    def widen(self, widened: Sequence[Widening]) -> None:
        """What walks may have added is this from now on; the end of the day solves the whole anew with it."""
        self._widened = list(widened)

    def beyond(self, base: State) -> tuple[list[Record], list[Step]]:
        """The windows and the steps that an earlier state does not have, of which this one is a copy that went on."""
        kept = {id(record.mean_x) for record in base._records}  # a record of a narrower band has the same means
        return [r for r in self._records if id(r.mean_x) not in kept], [s for s in self._steps if s not in base._steps]

    def take_also(self, records: Sequence[Record], steps: Sequence[Step]) -> None:
        """Take windows that were held, and the steps that they showed."""
        self._steps = sorted([*self._steps, *steps], key=lambda step: step.day)
        for record in records:
            self._begin(record)
            self._count(record.within(self._over.to_hz) or record)
        self._records.sort(key=lambda record: record.day)
        self.solve()

    def _begin(self, record: Record) -> bool:
        """A window comes: band and frequency may be settled by it. Returns whether one of them is another one now."""
        was, at_hz = self._over, self._over.at_hz
        self._over = was.begun(record, self._records)
        another = self._use_band(was)
        return another or self._over.at_hz != at_hz or self._over.late_s != was.late_s

    def _settle_temperature(self, record: Record) -> bool:
        """A window comes: S and Q hold at the temperature of the first that tells one, in whole degrees. Returns
        whether it is this one."""
        if not self._temperature.settles or not record.tells_temperature or self._zero_degc is not None:
            return False
        self._zero_degc = float(np.round(record.temperature_degc))
        return True

    def _use_band(self, was: OverFrequency) -> bool:
        """Of the records, only the motion within the band stays. Returns whether it is another one than it `was`."""
        if self._over.motion_hz == was.motion_hz:
            return False
        self._over, self._records = self._over.keeping(self._records)
        if was.motion_hz is not None:  # the unit of the response is another one: its old values are no beginning
            self._now = estimate([], self.statements, also=[self._now.day]).now
        return True

    def _know(self, record: Record) -> tuple[Record, Now]:
        """A window as far as its motion is used, and the state at its time, with the unknowns that no window had
        before."""
        anew = self._begin(record) | self._settle_temperature(record)
        record = record.within(self._over.to_hz) or record
        if self._fixed and np.isfinite(record.held_mps2).all():
            if self._held_mps2 is None:
                self._held_mps2, anew = record.held_mps2, True
            elif not never_turned(np.array([self._held_mps2, record.held_mps2])):
                self._fixed, anew = False, True  # the mount turned after all: from now on means tell Q and S alike
        if anew:
            if self._records:
                self.solve()
            else:
                day = self._now.day if self.windows else record.day
                self._now = estimate([], self.statements, also=[day]).now
        elif not self._records and self._now.day < record.day:
            self._now = estimate([], self.statements, also=[record.day]).now
        return record, self._now.passed_to(record.day).meeting(record)

    def _take(self, record: Record, ahead: Now, rows: Array) -> Self:
        self._count(record)
        self._now = ahead.with_window(record, rows)
        if self._moved():
            self.solve()
        return self

    def _count(self, record: Record) -> None:
        old, new = self._records[: 1 - SEVERAL], self._records[1 - SEVERAL :]
        old = [one if one.bands is None else replace(one, bands=None) for one in old]
        self._records = [*old, *new, record]
        self._over = self._over.taken(record)
        if record.tells_temperature:
            self._body = record.day, record.temperature_degc + record.behind_k
        self._used = [r for r in self._used if r != record.reference] + [record.reference]
        day = int(np.floor(record.day))
        self._newest_day = day if self._newest_day is None else max(self._newest_day, day)
        self.windows += 1

    def _moved(self) -> bool:
        """Whether an unknown is so far from where the windows were linearised that this must be done again."""
        now = self._now
        kinds = [quantity.kind for quantity in now.quantities]
        straight = np.array([kind.straight * (self.scale if kind.in_output_unit else 1.0) for kind in kinds])
        limit = np.maximum(straight, MOVED_U * np.sqrt(now.variance))
        return bool(np.any(np.abs(now.mean - now.x) > limit)) or changed(now, now.x)

    def step(self, u: Jump) -> None:
        """From now on unknowns, by key, may be off by as much more."""
        u = {key: size for key, size in u.items() if size > 0.0}
        if not u or (last := self.day) is None:
            return
        day = float(np.nextafter(last, np.inf))
        self._steps = [*self._steps, Step(day, u)]
        if any(key not in self._now for key in u):
            self.solve()
        else:
            self._now = replace(self._now.stepped(u), day=day)

    def remount(self, place: int | None = None) -> None:
        """The reference at a place was mounted again, or, where none is named, the sensor: what a mount decides may be
        another from now on.

        The new value is the old one and a difference: as large as that of two independent values, since it may be.
        """
        every = range(len(self._present))
        owners = [""] if place is None else []
        owners += [owner for k in (every if place is None else [place]) for owner in (self._present[k], f"place {k}")]
        priors = {unknown.key: unknown.u for unknown in self._now.unknowns.all}
        self.step({
            q.key: float(np.sqrt(2.0)) * priors[q.key]
            for q in self.quantities
            if q.owner in owners and not q.centre and (q.kind.of_reference or place is None)
            and "remount" in q.kind.loosened_by
        })  # fmt: skip
        if place is None:
            self._held_mps2 = None
            self.solve()

    def date_certificate(self, day: float | None, place: int = FIRST) -> None:
        """The date of the certificate of the reference at a place; its drift counts from there. None: no date is
        stated."""
        reference = self.reference(place)
        met = self._met.get(reference) or self._mounted(place, 1.0, None)
        first = not any(record.reference == reference for record in self._records)
        if first:  # later the day of the same date differs by the rounding of clocks alone
            self._met[reference] = replace(met, certified_day=day)
            self._restated()

    def _mounted(self, place: int, sensitivity: float, certified_day: float | None) -> Mounted:
        stated = {name: self._priors[place].values[name] for name in OF_REFERENCES}
        return Mounted(place, sensitivity, certified_day, stated)

    def _restated(self) -> None:
        """The statements changed: the newest epoch takes them for the unknowns that come later."""
        self._now = replace(self._now, unknowns=self._now.unknowns.with_statements(self.statements))

    def meet(self, reference: str, calibrated: str = "", sensitivity: float = 1.0, place: int = FIRST) -> bool:
        """A reference is at a place now. What is known of the one before it stays, and comes back with it.

        `calibrated` is the date of its certificate, "" where none is stated: a reference that was calibrated again is
        another one. `sensitivity` is that of its certificate. What the certificate states now holds for all windows of
        this reference. Returns whether that changed S or Q.
        """
        owner = self._owner(reference, calibrated)
        before, present = self._met.get(owner), self._present[place]
        met = self._mounted(place, sensitivity, None if before is None else before.certified_day)
        if before == met and present == owner:
            return False
        self._present[place], self._met[owner] = owner, met
        if before is not None and before.sensitivity != sensitivity:
            times = before.sensitivity / sensitivity
            self._records = [r.with_reference_times(times) if r.reference == owner else r for r in self._records]
        known = any(record.reference == owner for record in self._records)
        changed = known and before is not None and before != met
        if changed:
            was = self.result(place)
            self.solve()
            changed = not _equal(was, self.result(place))
        else:
            self._restated()
        if present not in ("", owner):
            self.remount(place)
        return changed

    def _owner(self, reference: str, calibrated: str) -> str:
        """The reference with the date of its certificate, as an owner of unknowns."""
        dated = f"{reference}{DATED}{calibrated}"
        if calibrated and dated not in self._met and reference in self._met:
            self._rename(reference, dated)  # the date of the same certificate was stated later
        if calibrated:
            return dated
        return next((known for known in reversed(self._met) if known.startswith(reference + DATED)), reference)

    def _rename(self, reference: str, dated: str) -> None:
        self._met = {(dated if of == reference else of): met for of, met in self._met.items()}
        self._present = [dated if of == reference else of for of in self._present]
        self._used = [dated if of == reference else of for of in self._used]
        self._records = [replace(r, reference=dated) if r.reference == reference else r for r in self._records]
        end = f" of {reference}"
        new = f" of {dated}"
        self._steps = [replace(own, u={_renamed(k, end, new): u for k, u in own.u.items()}) for own in self._steps]
        self._widened = [replace(own, u={_renamed(k, end, new): u for k, u in own.u.items()}) for own in self._widened]
        self.solve()

    def restate(self, gravity_mps2: tuple[float, float] | None = None) -> bool:
        """After `load`: whether what is stated now of sensor and mount changed S or Q.

        `gravity_mps2`: the local gravity as stated before and now, if that changed.
        """
        before, was = self.result(), self._over
        self._over = was.stating(self._band_hz)
        another = self._use_band(was)
        if gravity_mps2 is not None:
            ratio = gravity_mps2[1] / gravity_mps2[0]
            self._records = [record.with_gravity(ratio) for record in self._records]
            self._held_mps2 = None if self._held_mps2 is None else self._held_mps2 * ratio
        elif self._stated_then is None and not another:
            return False
        self._stated_then = None
        self.solve()
        return not _equal(before, self.result())

    def put(self, calibration: Calibration, day: float | None = None) -> None:
        """S and Q as an operator wants them, on a day after the newest window; None: just after it. Older windows tell
        nothing of S and Q from now on.

        How the errors of the calibration depend on those of the nuisances is not known. So the variances of both are
        doubled, also of nuisances that come later: the joint covariance is not too small, whatever the correlation is
        (covariance intersection with equal weights; Julier and Uhlmann 1997).
        """
        values = np.append(calibration.sensitivity.ravel(), calibration.offset)
        last, u = self.day, np.sqrt(self._now.variance)
        loose = {q.key: float(np.sqrt(DOUBT)) * s for q, s in zip(self.quantities, u.tolist(), strict=True)}
        flat = replace(self.statements, u=np.full(12, np.inf)).u_parameters
        loose |= {q.key: s for q, s in zip(S_AND_Q, flat.tolist(), strict=True)}
        if day is None:
            day = self._now.day if last is None else float(np.nextafter(last, np.inf))
        self._steps = [*self._steps, Step(day, loose)]
        self._held_mps2 = None  # Q is known again; the next window of a fixed mount makes the mean output of it
        self._dated = [*self._dated, Dated(day, values, (1.0 + DOUBT) * calibration.covariance)]
        self.solve()

    # --- state

    def _stated(self) -> list[Any]:
        temperature = asdict(self._temperature)
        u_offset = list(temperature.pop("u_offset_mps2"))
        priors = [[dict(own.values), repr(own.known)] for own in self._priors]
        return [self._mean.tolist(), self._u.tolist(), priors, dict(self._wander.values), temperature, u_offset]

    def snapshot(self) -> dict[str, Any]:
        """All that changes, exactly."""
        return {
            "records": [record.snapshot() for record in self._records],
            "steps": [asdict(step) for step in self._steps],
            "widened": [asdict(widening) for widening in self._widened],
            "dated": [{"day": d.day, "mean": d.mean, "covariance": d.covariance} for d in self._dated],
            "present": list(self._present),
            "met": {reference: asdict(met) for reference, met in self._met.items()},
            "used": list(self._used),
            "over": self._over.snapshot(),
            "held_mps2": self._held_mps2,
            "fixed": self._fixed,
            "zero_degc": self._zero_degc,
            "body": None if self._body is None else list(self._body),
            "now": self._now.snapshot(),
            "stated": self._stated(),
            "newest_day": self._newest_day,
            "windows": self.windows,
            "merged_at": self._merged_at,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from a snapshot. Where it was made with other statements, `restate` and `meet` must follow."""
        self._records = [Record.load(record) for record in state["records"]]
        self._steps = [Step(**step) for step in state["steps"]]
        self._widened = [Widening(**widening) for widening in state["widened"]]
        self._dated = [Dated(d["day"], np.array(d["mean"]), np.array(d["covariance"])) for d in state["dated"]]
        for place, reference in enumerate(state["present"][: len(self._present)]):
            self._present[place] = reference
        self._met = {reference: Mounted(**met) for reference, met in state["met"].items()}
        self._used = list(state["used"])
        self._over = OverFrequency.load(state["over"])
        self._held_mps2 = None if state["held_mps2"] is None else np.array(state["held_mps2"])
        self._fixed = self._fixed and state["fixed"]  # a mount that turned once is fixed no more
        self._newest_day, self.windows, self._merged_at = state["newest_day"], state["windows"], state["merged_at"]
        self._zero_degc = state["zero_degc"]
        self._body = None if (body := state["body"]) is None else (body[0], body[1])
        self._now = Now.load(state["now"], self.statements, self._records)
        self._stated_then = None if state["stated"] == self._stated() else state["stated"]


def _newest(records: Sequence[Record]) -> list[Record]:
    """Those of the positions and of the references that were used last: each has unknowns of its own."""
    positions = list(dict.fromkeys(r.pose.position for r in reversed(records)))[:MOST_POSITIONS]
    references = list(dict.fromkeys(r.reference for r in reversed(records)))[:MOST_REFERENCES]
    return [r for r in records if r.pose.position in positions and r.reference in references]


def _lag_of(reference: str) -> str:
    return Quantity("lag", LAG, owner=reference).key


def _renamed(key: str, end: str, new: str) -> str:
    for tail in (end, f"{end}, centre"):
        if key.endswith(tail):
            return key[: -len(tail)] + tail.replace(end, new)
    return key


def _equal(one: Calibration, other: Calibration) -> bool:
    alike = np.array_equal(one.sensitivity, other.sensitivity) and np.array_equal(one.offset, other.offset)
    return bool(alike and np.array_equal(one.covariance, other.covariance))
