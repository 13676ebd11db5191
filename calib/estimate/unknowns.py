"""The unknowns of an estimate: their priors, how they change with time, and how they act on a window."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from calib.estimate import physics
from calib.estimate import quantities as kinds
from calib.estimate.chain import Passage
from calib.estimate.quantities import (
    ALL_RATES,
    BEHIND,
    OFFSET_RATE,
    RATES,
    S_AND_Q,
    SENSITIVITY_PER_K,
    SENSITIVITY_RATE,
    YEAR_DAYS,
    Quantity,
    offset_temperature,
)
from calib.estimate.statements import DOUBT, FLAT, Dated, Statements, Widening
from calib.estimate.terms import Term, reference_over_temperature, terms
from calib.model import Array
from calib.windows.record import Record

EXACT = 1e-9  # standard uncertainty, relative to the scale, of what is known exactly
LEAST_KEPT = 1e-6  # of its distance from the centre, what a bounded walk keeps over the longest pause


@dataclass(frozen=True, slots=True)
class Unknown:
    """One of them: its prior on the day `since`, and the variance a day of its random walk from then on.

    The walk is a Gauss-Markov process about its centre, whose variance never exceeds `bound`. The centre is the mean of
    the prior, or for S and Q, where these have steps or rates, an unknown of its own, which these move as well.
    """

    quantity: Quantity
    mean: float
    u: float
    since: float
    a_day: float = 0.0
    bound: float = np.inf

    @property
    def key(self) -> str:
        """Identifies it."""
        return self.quantity.key

    def relaxed(self, days: float) -> tuple[float, float]:
        """The part of its distance from the centre that it keeps over so many days, and the variance it gains."""
        gained = self.a_day * days
        if not np.isfinite(self.bound) or gained == 0.0:
            return 1.0, gained
        kept = max(float(np.exp(-0.5 * gained / self.bound)), LEAST_KEPT)
        return kept, self.bound * (1.0 - kept**2)


class Unknowns:
    """All unknowns of some records under some statements: N of them, S and Q (12) first."""

    def __init__(self, statements: Statements, records: Sequence[Record]) -> None:
        self._begin(statements, records)
        self._add(self._of_sensor())
        for record in sorted(records, key=lambda r: r.days[0]):  # merged ones overlap
            self.meet(record)

    def _begin(self, statements: Statements, records: Sequence[Record]) -> None:
        self.statements = statements
        self.begin = min((*(r.days[0] for r in records), *(d.day for d in statements.dated)), default=0.0)
        self.all: list[Unknown] = []
        self.at: dict[str, int] = {}
        self._terms: dict[tuple[object, ...], list[Term]] = {}
        self._effects: dict[tuple[object, ...], Array] = {}
        self._taken_out: dict[tuple[object, ...], Array] = {}

    def __len__(self) -> int:
        return len(self.all)

    def __contains__(self, setting: object) -> bool:
        """Whether the unknowns of records with this setting are here."""
        return setting in self._terms

    def meet(self, record: Record) -> list[Unknown]:
        """The unknowns of a record that were not there before, which come in with their priors."""
        if record.setting in self:
            return []
        self._terms[record.setting] = self._terms_of(record)
        self._effects.clear()
        self._taken_out.clear()
        new = self._add(found for t in self._terms[record.setting] for found in self._of_term(t, record))
        if record.tells_temperature:
            model = self.statements.temperature
            of_S, behind = (told(self.statements.scale) for told in (model.of_sensitivity, model.behind))
            new += self._add(Unknown(quantity, 0.0, u, self.begin) for quantity, u in (*of_S, *behind))
        return new

    def _terms_of(self, record: Record) -> list[Term]:
        stated = self.statements.of(record.reference)
        own = terms([record.pose], record.channels, stated, {}, record.reference)
        if record.tells_temperature:
            own += reference_over_temperature(record.channels, stated, record.reference)
        return [replace(t, quantity=self.placed(t.quantity)) for t in own if t.uncertainty > 0.0]

    def with_statements(self, statements: Statements) -> Unknowns:
        """The same unknowns; those that are met later come in with other statements."""
        other = copy(self)
        other.statements = statements
        other.all, other.at, other._terms = list(self.all), dict(self.at), dict(self._terms)
        other._effects, other._taken_out = {}, {}
        return other

    @classmethod
    def loaded(cls, statements: Statements, records: Sequence[Record], all_: Iterable[Unknown]) -> Unknowns:
        """Those of a snapshot, in their order. What is an unknown only by the statements of now is none."""
        found = object.__new__(cls)
        found._begin(statements, records)
        found._add(all_)
        for record in records:
            if record.setting not in found:
                found._terms[record.setting] = [t for t in found._terms_of(record) if t.key in found.at]
        return found

    def placed(self, quantity: Quantity) -> Quantity:
        """A quantity of the place of a reference is that of the place, whichever reference stands there."""
        if not quantity.kind.of_place:
            return quantity
        return replace(quantity, owner=f"place {self.statements.places.get(quantity.owner, 0)}")

    def _add(self, found: Iterable[Unknown]) -> list[Unknown]:
        new = []
        for unknown in found:
            if unknown.key not in self.at:
                self.at[unknown.key] = len(self.all)
                self.all.append(unknown)
                new.append(unknown)
        return new

    def _of_s_and_q(self) -> list[Unknown]:
        s, unknowns = self.statements, []
        # A tilt moves the mean output of a mount that never turns.
        tilted_mps2 = 0.0 if s.held_mps2 is None else float(np.linalg.norm(s.held_mps2))
        walks = s.wander.variance_a_day(s.scale, tilted_mps2).tolist()
        for quantity, mean, stated, walk in zip(S_AND_Q, s.mean.tolist(), s.u_parameters.tolist(), walks, strict=True):
            u = max(stated, EXACT * s.scale)
            bound = u**2 if u < 0.5 * FLAT * s.scale else np.inf
            unknowns.append(Unknown(quantity, mean, u, self.begin, walk, bound))
        return unknowns

    def _of_sensor(self) -> Iterable[Unknown]:
        s, begin = self.statements, self.begin
        stepping = {key for step in s.steps for key in step.u}
        unknowns = self._of_s_and_q()
        yield from unknowns
        rate_u, rate_walk = (s.wander.of(w) * s.scale for w in (OFFSET_RATE.prior, OFFSET_RATE.walk))
        for name in ALL_RATES:
            if name in RATES:
                bound = rate_u**2 or np.inf  # stated to begin at 0, it may still walk
                yield Unknown(Quantity(name, OFFSET_RATE), 0.0, rate_u or EXACT * s.scale, begin, rate_walk**2, bound)
            elif name in stepping:
                yield Unknown(Quantity(name, SENSITIVITY_RATE), 0.0, EXACT * s.scale, begin)
        for own, rate in zip(unknowns, ALL_RATES, strict=True):
            if own.a_day and np.isfinite(own.bound) and (rate in RATES or stepping & {own.key, rate}):
                yield Unknown(replace(own.quantity, centre=True), own.mean, EXACT * s.scale, begin)
        for quantity, u in s.temperature.of_offset(s.scale):
            yield Unknown(quantity, 0.0, u, begin)

    def _of_term(self, t: Term, record: Record) -> Iterable[Unknown]:
        s, since, kind = self.statements, record.days[0], t.kind
        u, walk = t.uncertainty, s.wander.of(kind.walk)
        if any(stated.day <= since for stated in s.dated):  # S and Q may owe their errors to this one
            u *= float(np.sqrt(1.0 + DOUBT))
        if kind.since_certificate:
            walk = u / np.sqrt(YEAR_DAYS)
            years = max(since - s.certified.get(record.reference, since), 0.0) / YEAR_DAYS
            # The value at the beginning stays, beside the walk since then: what S owes to it is told (reference_share).
            yield Unknown(replace(t.quantity, centre=True), t.expected, max(u * np.sqrt(years), EXACT), since)
            yield Unknown(t.quantity, 0.0, EXACT, since, float(walk**2))
            return
        bound = 4.0 * u**2  # later the mount may lean by more than its prior says of the day of mounting
        yield Unknown(t.quantity, t.expected, u, since, float(walk**2), bound if walk else np.inf)

    @property
    def a_day(self) -> Array:
        """(12,) variance a day of the random walks of S and Q."""
        return np.array([unknown.a_day for unknown in self.all[:12]])

    @property
    def rates_begin(self) -> list[float]:
        """Days after the first window at which S or Q may have begun to drift: an epoch begins there."""
        begun = (step.day for step in self.statements.steps if not set(ALL_RATES).isdisjoint(step.u))
        return [day for day in begun if day > self.begin]

    @property
    def prior(self) -> tuple[Array, Array]:
        """Means and standard uncertainties (N,) before any data; with the steps of before the first window."""
        u = np.array([unknown.u for unknown in self.all])
        for step in self.statements.steps:
            if step.day <= self.begin:
                for key, more in step.u.items():
                    if (k := self.at.get(key)) is not None:
                        u[k] = np.hypot(u[k], more)
        return np.array([unknown.mean for unknown in self.all]), u

    def passage(self, before: float, after: float) -> tuple[Array, Array, Passage]:
        """From one day to another: F (N, N), f (N,) of x' = F x + f, and the passage with the gap 0."""
        size, s, days = len(self.all), self.statements, max(after - before, 0.0)
        follows, shift, walks = np.eye(size), np.zeros(size), dict[int, Array]()
        for k, own in enumerate(self.all):
            if own.a_day == 0.0:
                continue
            kept, variance = own.relaxed(max(after - max(before, own.since), 0.0))
            follows[k, k] = kept
            if kept < 1.0:
                if (centre := self._centre(own.quantity)) is not None:
                    follows[k, centre] = 1.0 - kept
                else:
                    shift[k] = (1.0 - kept) * own.mean
            if variance > 0.0:
                walks[k] = np.sqrt(variance) * np.eye(size)[k]
        for quantity, name in zip(S_AND_Q, ALL_RATES, strict=True):
            if (rate := self.at.get(name)) is None:
                continue
            k, centre = self.at[quantity.key], self._centre(quantity)
            moved = [k] if centre is None else [k, centre]
            follows[moved, rate] += 0.5 * days * (1.0 + follows[rate, rate])
            if (walk := walks.get(rate)) is not None:  # the mean of a random walk: half of its end, and a bridge
                bridge = days / np.sqrt(12.0) * walk[rate] * np.eye(size)[k]
                walk[moved] = 0.5 * days * walk[rate]
                walks[k] = np.hypot(walks.get(k, np.zeros(size)), bridge)
        noises = list(walks.values())
        for step in s.steps:
            if before < step.day <= after:
                noises += self.stepped(step.u)
        noises += self.stepped(_widened(s.widened, before, after))
        noise = np.array(noises).reshape(-1, size).T
        back = np.asarray(np.linalg.inv(follows), dtype=np.float64)
        return follows, shift, Passage.of(back, np.zeros(size), noise)

    def _centre(self, quantity: Quantity) -> int | None:
        return None if quantity.kind.since_certificate else self.at.get(replace(quantity, centre=True).key)

    def stepped(self, u: Mapping[str, float]) -> list[Array]:
        """The changes (N,) of one standard uncertainty each that a step makes; its centre moves with S or Q."""
        found = []
        for key, size in u.items():
            if size > 0.0 and (k := self.at.get(key)) is not None:
                change = np.zeros(len(self.all))
                change[k] = size
                if (centre := self._centre(self.all[k].quantity)) is not None:
                    change[centre] = size
                found.append(change)
        return found

    def dated(self, stated: Dated, x: Array) -> Array:
        """Rows (12, N + 1) of a calibration that an operator put in force, at the values x (N,)."""
        values, ways = np.linalg.eigh(stated.covariance)
        white = (ways / np.sqrt(np.maximum(values, np.finfo(float).tiny))).T
        values_of = np.eye(12)  # S and Q by S and, where it stands in the place of Q, the mean output
        if (held := self.statements.held_mps2) is not None:
            values_of[9:, :9] = -np.kron(np.eye(3), held)
        rows = np.zeros((12, len(self.all) + 1))
        rows[:, :12], rows[:, -1] = white @ values_of, white @ (stated.mean - values_of @ x[:12])
        return rows

    # --- effects on a window

    def effect(self, record: Record, epoch_day: float, *, at_zero: bool = False) -> tuple[Array, Array]:
        """(SIZE, N) of one unit of each unknown on the inputs of a window (calib.estimate.physics), and (N,) what its
        front end took out, at an epoch that has this day. `at_zero`: not at the temperature of the window, but at that
        of S and Q."""
        if record.setting not in self._effects:
            self._effects[record.setting] = self._effect(record)
        effect, away = self._effects[record.setting], record.day - epoch_day
        per_k = {"above": 0.0 if at_zero else self._above_k(record), "behind": 0.0 if at_zero else record.behind_k}
        by_temperature = [(k, own.quantity.kind.per_k) for k, own in enumerate(self.all) if own.quantity.kind.per_k]
        if away or by_temperature:
            effect = effect.copy()
        for k, which in by_temperature:
            effect[:, k] *= per_k[which]
        if away:
            for p, name in enumerate(ALL_RATES):
                if (rate := self.at.get(name)) is not None:
                    effect[:, rate] += away * effect[:, p]
        key = record.setting, record.lag_s, record.response
        if key not in self._taken_out:
            self._taken_out[key] = self._response_taken_out(record)
        return effect, self._taken_out[key]

    def _above_k(self, record: Record) -> float:
        """The temperature of a window over that of S and Q; 0 where it is not known."""
        degc = record.temperature_degc
        return degc - self.statements.temperature.reference_degc if record.tells_temperature else 0.0

    def _response_taken_out(self, record: Record) -> Array:
        found, priors = np.zeros(len(self.all)), self.statements.of(record.reference)
        values = {
            kinds.LAG: (record.lag_s,), kinds.RESPONSE: record.response,
            kinds.REFERENCE_CORNER: (priors.reference_corner_at_hz,),
            kinds.SENSOR_CORNER: (priors.sensor_corner_at_hz,),
        }  # fmt: skip
        for t in self._terms[record.setting]:
            found[self.at[t.key]] = t.with_applied(values).applied
        return found

    def _effect(self, record: Record) -> Array:
        found = np.zeros((physics.SIZE, len(self.all)))
        found[physics.S, :9], found[physics.Q, 9:12] = np.eye(9), np.eye(3)
        found[physics.S] += self._named(SENSITIVITY_PER_K) + self._named(BEHIND[:9])
        found[physics.Q] += self._named(BEHIND[9:])
        found[physics.OVER_T] += np.vstack([self._named(offset_temperature(power)) for power in (1, 2)])
        for t in self._terms[record.setting]:
            (own,) = t.on_inputs(1)
            own[physics.Q] *= self.statements.scale
            found[:, self.at[t.key]] += own
            if t.kind.since_certificate:
                found[:, self.at[replace(t.quantity, centre=True).key]] += own
        return found

    def _named(self, names: Sequence[str]) -> Array:
        """(len(names), N) ones where unknowns of these names are."""
        found = np.zeros((len(names), len(self.all)))
        for row, name in enumerate(names):
            if name in self.at:
                found[row, self.at[name]] = 1.0
        return found


def _widened(widened: Sequence[Widening], before: float, after: float) -> dict[str, float]:
    """The standard uncertainties, by key, of what widened walks may add from one day to another."""
    variance: dict[str, float] = {}
    for own in widened:
        if (share := (min(after, own.until) - max(before, own.since)) / (own.until - own.since)) > 0.0:
            for key, u in own.u.items():
                variance[key] = variance.get(key, 0.0) + share * u**2
    return {key: float(np.sqrt(value)) for key, value in variance.items()}
