"""estimate(records, statements): S, Q and everything else, now and at any earlier time, by one least-squares solution.

    unknowns    x_k (N): one value an epoch, of which most do not change (angles, gravity, certificates)
    windows     y_w = h_w(A_w (x_k - taken out)) + e        cov e: noise pooled over windows, scatter between windows
    walks       x_(k+1) = F_k x_k + f_k + G_k w_k           w of unit variance: walks, and steps that are stated
    priors      x_0 = stated + e

With every uncertainty of a nuisance 0 and no walk it is Method 3 (section 2.3): the least squares of all points.
Gauss-Newton: each pass linearises all lines at the estimate of the last one; QR eliminates epoch after epoch
(calib.estimate.chain). Its derivatives stay at the mean of each unknown between two of its steps (calib.estimate.rows).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from calib.distributions import coverage_factor
from calib.estimate.chain import EpochLink, NearIdentity, Passage, gains, passed, returned, solved
from calib.estimate.gauss_newton import Linearised, gauss_newton
from calib.estimate.innovation import Innovation, innovation
from calib.estimate.physics import SIZE, STEP, Stack, Windows
from calib.estimate.quantities import KINDS, LAG, PRIOR, RESPONSE, Quantity
from calib.estimate.rows import NoiseScores, Rows, TemperatureSpread
from calib.estimate.statements import Statements
from calib.estimate.unknowns import Unknown, Unknowns
from calib.model import Array
from calib.signal.order_statistics import distinct
from calib.windows.record import Record, together
from calib.windows.type_a import Index

Seen = tuple[float, float]  # the lowest and highest temperature in degC of a window; NaN before any had one


@dataclass(frozen=True, eq=False)
class Now:
    """What is known at the newest epoch, on `day`: the triangle `root` (N, N + 1) on deviations from `x` (N,).

    The derivatives of the next windows are those at the values `around` (N,). `chi2`: the sum of squares of all rows.
    """

    unknowns: Unknowns
    noise: NoiseScores
    seen_degc: Seen
    day: float
    x: Array
    around: Array
    root: Array
    chi2: float

    @cached_property
    def _solved(self) -> tuple[Array, Array]:
        return solved(self.root)

    @property
    def mean(self) -> Array:
        """(N,) of all unknowns."""
        return self.x + self._solved[0]

    @property
    def factor(self) -> Array:
        """(N, N) a factor of their covariance."""
        return self._solved[1]

    @property
    def variance(self) -> Array:
        """(N,) the diagonal of their covariance."""
        return np.asarray(np.einsum("ij,ij->i", self.factor, self.factor))

    @property
    def quantities(self) -> list[Quantity]:
        """What the unknowns are."""
        return [unknown.quantity for unknown in self.unknowns.all]

    @property
    def keys(self) -> list[str]:
        """What identifies them."""
        return list(self.unknowns.at)

    def __len__(self) -> int:
        return len(self.x)

    def __contains__(self, key: str) -> bool:
        return key in self.unknowns.at

    def index(self, key: str) -> int:
        """Where an unknown is. Raises KeyError where it is none."""
        return self.unknowns.at[key]

    @property
    def coverage_factor(self) -> float:
        """For about 95 %."""
        return coverage_factor(self.noise.degrees_of_freedom or np.inf)

    # --- forward in time

    def passed_to(self, day: float) -> Now:
        """At a later day, with what was stated to happen in between."""
        if day <= self.day:
            return self
        follows, shift, passage = self.unknowns.passage(self.day, day)
        root, _ = passed(self.root, passage)
        around = self.around + (follows @ self.x + shift - self.x)
        return replace(self, day=day, x=follows @ self.x + shift, around=around, root=root)

    def meeting(self, record: Record) -> Now:
        """With the unknowns of a window that were not there before, which are independent of all others."""
        if record.setting in self.unknowns:
            return self
        unknowns = self.unknowns.with_statements(self.unknowns.statements)
        new = unknowns.meet(record)
        size, more = len(self), len(new)
        root = np.zeros((size + more, size + more + 1))
        root[:size, :size], root[:size, -1] = self.root[:, :-1], self.root[:, -1]
        mean, u = np.array([own.mean for own in new]), np.array([own.u for own in new])
        _, taken_out = unknowns.effect(record, record.day)
        told = np.array([own.quantity.kind in (LAG, RESPONSE) for own in new], dtype=bool)
        x = np.where(told & (taken_out[size:] != 0.0), taken_out[size:], mean)
        root[range(size, size + more), range(size, size + more)] = 1.0 / u
        root[size:, -1] = (mean - x) / u
        return replace(self, unknowns=unknowns, x=np.append(self.x, x), around=np.append(self.around, x), root=root)

    def stepped(self, u: Mapping[str, float]) -> Now:
        """After a step of unknowns, by key, with these standard uncertainties."""
        if not (changes := self.unknowns.stepped(u)):
            return self
        size = len(self)
        root, _ = passed(self.root, Passage.of(np.eye(size), np.zeros(size), np.array(changes).T))
        return replace(self, root=root)

    def rows(self, record: Record, at: Array | None = None) -> Array:
        """(r, N + 1) what a window says of the deviations from `x`, linearised at the values `at` (N,)."""
        noise = self.noise.pooled(record)
        spread = TemperatureSpread.of(self.unknowns, self.seen_degc, self.x)
        values, around = (self.x, self.around) if at is None else (at, at)
        (rows,) = Rows(self.unknowns, [record], np.array([self.day]), [noise], spread).at(values[None], around[None])
        if at is not None:
            rows[:, -1] += rows[:, :-1] @ (at - self.x)
        return np.asarray(rows[np.abs(rows[:, :-1]).max(axis=1, initial=0.0) > 0.0])

    def under_gravity(self, record: Record) -> tuple[Array, Array]:
        """(3,) the part of the mean output that is not Q, in the pose of a record, and its derivatives (3, N); at the
        temperature of S and Q."""
        s = self.unknowns.statements
        p = s.of(record.reference)
        windows = Windows(
            Stack.of([record], fixed=False), s.temperature.reference_degc,
            at_hz=p.reference_frequency_hz, share=p.reference_share, known_size=p.known_size,
        )  # fmt: skip
        effect, taken_out = self.unknowns.effect(record, self.day, at_zero=True)
        inputs = effect @ (self.mean - taken_out)
        live = np.flatnonzero(effect.any(axis=1))
        moved = inputs + 1j * STEP * np.eye(SIZE)[live]
        by = windows.under_gravity(moved[:, None])[:, 0].imag / STEP
        return windows.under_gravity(inputs[None])[0], np.asarray(by.T @ effect[live])

    def says(self, rows: Array) -> Innovation:
        """What rows of a window say against this."""
        return innovation(rows, self._solved[0], self.factor)

    def snapshot(self) -> dict[str, Any]:
        """Plain values, for `load`; bit for bit."""
        unknowns = [
            [q.name, q.kind.name, q.position, q.owner, q.centre, own.mean, own.u, own.since, own.a_day, own.bound]
            for own in self.unknowns.all
            for q in [own.quantity]
        ]
        return {
            "unknowns": unknowns, "noise": asdict(self.noise), "seen_degc": list(self.seen_degc), "day": self.day,
            "x": self.x, "around": self.around, "root": self.root,
            "chi2": self.chi2,
        }  # fmt: skip

    @classmethod
    def load(cls, state: Mapping[str, Any], statements: Statements, records: Sequence[Record]) -> Now:
        """That of a snapshot. Raises KeyError where the table of unknowns does not have one of its kinds."""
        unknowns = (
            Unknown(Quantity(name, KINDS[kind], position, owner, centre), *rest)
            for name, kind, position, owner, centre, *rest in state["unknowns"]
        )
        low, high = state["seen_degc"]
        return cls(
            Unknowns.loaded(statements, records, unknowns), NoiseScores(**state["noise"]), (low, high), state["day"],
            np.array(state["x"]), np.array(state["around"]), np.array(state["root"]), state["chi2"],
        )  # fmt: skip

    def with_window(self, record: Record, rows: Array) -> Now:
        """With the rows of one more window."""
        seen, degc = self.seen_degc, record.temperature_degc
        if np.isfinite(degc):
            seen = float(np.fmin(seen[0], degc)), float(np.fmax(seen[1], degc))
        root = np.asarray(np.linalg.qr(np.vstack([self.root, rows]), mode="r"))
        size = len(self)
        left = float(root[size, size] ** 2) if len(root) > size else 0.0  # what the rows add to the sum of squares
        return replace(self, root=root[:size], noise=self.noise.pooled(record), seen_degc=seen, chi2=self.chi2 + left)


@dataclass(frozen=True, slots=True, eq=False)
class Then:
    """What all windows say of an epoch, `now`, and of what walks and steps changed from it to the next one: `moved`
    (N,), and a factor (N, J) of its covariance."""

    now: Now
    moved: Array
    moved_factor: Array


@dataclass(frozen=True, eq=False)
class Estimate:
    """`days` (K,) of the epochs, `x` (K, N) the point of linearisation, `root` the triangle of the last epoch, `links`
    those between epochs. `noise` (W), `epoch_of` (W,) and `rows`: the noise, the epoch and the rows of each record."""

    unknowns: Unknowns
    records: Sequence[Record]
    noise: Sequence[NoiseScores]
    seen_degc: Seen
    days: Array
    epoch_of: Index
    x: Array
    around: Array
    root: Array
    links: Sequence[EpochLink]
    rows: Sequence[Array]
    chi2: float
    passes: int

    @property
    def now(self) -> Now:
        """What is known at the last epoch."""
        return Now(
            self.unknowns,
            self.noise[-1] if self.noise else NoiseScores(),
            self.seen_degc,
            float(self.days[-1]),
            self.x[-1],
            self.around[-1],
            self.root,
            self.chi2,
        )

    def past(self) -> Iterator[Then]:
        """All epochs by all windows before and after each, from the last one back to the first."""
        root, size = self.root, len(self.unknowns)
        yield Then(self.now, np.zeros(size), np.zeros((size, 0)))
        for k in range(len(self.links) - 1, -1, -1):
            link, j = self.links[k], len(self.links[k].z)
            joint = returned(root, link)
            d, factor = solved(joint)
            root, noise = joint[j:, j:], link.passage.noise
            then = replace(self.now, day=float(self.days[k]), x=self.x[k], around=self.around[k], root=root)
            yield Then(then, noise @ d[:j], noise @ factor[:j])

    def with_window(self, record: Record) -> Estimate | None:
        """With one more window, appended as `Now.with_window` does it; None where that is not later than all others, or
        has unknowns of its own."""
        if record.setting not in self.unknowns or record.day <= self.days[-1]:
            return None
        record = together([*self.records, record], fixed=self.unknowns.statements.held_mps2 is not None)[-1]
        now = self.now
        ahead, noise = now.passed_to(record.day), now.noise.pooled(record)
        spread, days = TemperatureSpread.of(self.unknowns, self.seen_degc, ahead.x), np.append(self.days, record.day)
        (rows,) = Rows(self.unknowns, [record], days[-1:], [noise], spread).at(ahead.x[None], ahead.around[None])
        root, link = passed(self.root, self.unknowns.passage(float(self.days[-1]), record.day)[2], rows)
        return replace(
            self, records=[*self.records, record], noise=[*self.noise, noise], days=days, root=root,
            links=[*self.links, link], epoch_of=np.append(self.epoch_of, len(days) - 1),
            x=np.vstack([self.x, ahead.x]), around=np.vstack([self.around, ahead.around]), rows=[*self.rows, rows],
        )  # fmt: skip

    def budget(self, by: Array) -> dict[str, Array]:
        """By source, what it adds to the variances (m,) of quantities of the last epoch, of which `by` (m, N) are the
        derivatives by the unknowns. All together are their variances."""
        factor, found = self.now.factor, dict[str, Array]()

        def add(source: str, variance: Array) -> None:
            found[source] = found.get(source, 0.0) + variance

        epochs = list(gains(self.links, factor @ (by @ factor).T))[::-1]
        for own, u, gain in zip(self.unknowns.all, self.unknowns.prior[1], epochs[0][0], strict=True):
            add(own.quantity.kind.source, (gain / u) ** 2)
        for link, (_, noise) in zip(self.links, epochs[1:], strict=True):
            for moved, gain in zip(link.passage.noise.T, noise, strict=True):
                kind = self.unknowns.all[int(np.flatnonzero(moved)[0])].quantity.kind
                add(kind.walked_source or kind.source, gain**2)
        for stated in self.unknowns.statements.dated:
            k = int(np.searchsorted(self.days, stated.day))
            rows = self.unknowns.dated(stated, self.x[k])[:, :-1]
            add(PRIOR, ((rows @ epochs[k][0]) ** 2).sum(axis=0))
        spread = TemperatureSpread.of(self.unknowns, self.seen_degc, self.x[-1])
        rows_of = Rows(self.unknowns, self.records, self.days[self.epoch_of], self.noise, spread)
        by_record = [own[:, :-1] @ epochs[k][0] for own, k in zip(self.rows, self.epoch_of.tolist(), strict=True)]
        for source, variance in rows_of.shares(by_record).items():
            add(source, variance)
        return found


def estimate(
    records: Sequence[Record],
    statements: Statements,
    *,
    start: Now | None = None,
    also: Sequence[float] = (),
    beside: Sequence[Record] = (),
) -> Estimate:
    """Everything, from the records and the statements alone.

    `start`: where the passes begin, if not at the priors; it does not change the result. `also`: days that get an epoch
    with or without a window. `beside`: further records, which only tell how noisy those near them are.
    """
    every = sorted([(r.day, True, r) for r in records] + [(r.day, False, r) for r in beside], key=lambda each: each[0])
    around = NoiseScores.around([r for *_, r in every])
    noise = [own for (_, counts, _), own in zip(every, around, strict=True) if counts]
    records = together(sorted(records, key=lambda r: r.day), fixed=statements.held_mps2 is not None)
    unknowns = Unknowns(statements, records)
    stated = [d.day for d in statements.dated] + unknowns.rates_begin
    stated += [unknowns.begin] if records else []  # before the middle of the first record, if windows were merged
    days = distinct(np.array([*(r.day for r in records), *stated, *also], dtype=np.float64))
    if not len(days):
        days = np.array([unknowns.begin])
    solution = _Passes(unknowns, records, days, noise, _seen(records))
    return solution.solved(start)


def _seen(records: Sequence[Record]) -> Seen:
    told = [r.temperature_degc for r in records if np.isfinite(r.temperature_degc)]
    return (min(told), max(told)) if told else (np.nan, np.nan)


class _Passes:
    """The passes of one estimate."""

    def __init__(
        self, unknowns: Unknowns, records: Sequence[Record], days: Array, noise: Sequence[NoiseScores], seen_degc: Seen
    ) -> None:
        self.unknowns, self.records, self.days, self.noise, self.seen_degc = unknowns, records, days, noise, seen_degc
        self.epoch_of = np.searchsorted(days, [r.day for r in records])
        self.passages = [
            (NearIdentity.of(follows), shift, passage)
            for a, b in zip(days.tolist(), days.tolist()[1:], strict=False)
            for follows, shift, passage in [unknowns.passage(a, b)]
        ]
        self.mean, self.u = unknowns.prior
        self._segments = self._between_steps()
        self._rows, self.by_record = self._rows_at(self.mean), list[Array]()
        # What a window without a temperature weighs depends on how Q changes with temperature.
        untold = any(not np.isfinite(r.temperature_degc) for r in records)
        self.unsure = bool(untold and np.isfinite(seen_degc).all())

    def _rows_at(self, x: Array) -> Rows:
        spread = TemperatureSpread.of(self.unknowns, self.seen_degc, x)
        return Rows(self.unknowns, self.records, self.days[self.epoch_of], self.noise, spread)

    def _between_steps(self) -> Array:
        """(K, N) how many steps each unknown has made before each epoch."""
        found = np.zeros((len(self.days), len(self.unknowns)), dtype=int)
        for step in self.unknowns.statements.steps:
            for change in self.unknowns.stepped(step.u):
                found[np.ix_(self.days >= step.day, change != 0.0)] += 1
        return found

    def around(self, x: Array) -> Array:
        """(K, N) the mean of each unknown between two of its steps."""
        found = np.empty_like(x)
        for k in range(int(self._segments.max(initial=0)) + 1):
            own = self._segments == k
            count = np.maximum(own.sum(axis=0), 1)
            found = np.where(own, (x * own).sum(axis=0) / count, found)
        return found

    def begun(self, start: Now | None) -> Array:
        """(K, N) where the passes begin: at the priors, at what the front end took out where data alone tell an
        unknown, or at an earlier estimate."""
        first = self.mean.copy()
        for record in {r.reference: r for r in self.records}.values():
            _, taken_out = self.unknowns.effect(record, record.day)
            for k, unknown in enumerate(self.unknowns.all):
                if unknown.quantity.kind in (LAG, RESPONSE) and taken_out[k]:
                    first[k] = taken_out[k]
        if start is not None:
            for key, k in self.unknowns.at.items():
                if key in start:
                    first[k] = start.mean[start.index(key)]
            return np.tile(first, (len(self.days), 1))
        x = [first]
        for follows, shift, _ in self.passages:
            x.append(follows.whole @ x[-1] + shift)
        return np.array(x)

    def lines_at(self, x: Array) -> Linearised:
        """All lines at x (K, N); the rows of each record are then in `by_record`."""
        if self.unsure:
            self._rows = self._rows_at(x[-1])
        around, size = self.around(x), len(self.unknowns)
        self.by_record = self._rows.at(x[self.epoch_of], around[self.epoch_of]) if self.records else []
        by_epoch: list[list[Array]] = [[] for _ in self.days]
        for own, k in zip(self.by_record, self.epoch_of.tolist(), strict=True):
            by_epoch[k].append(own)
        for stated in self.unknowns.statements.dated:
            k = int(np.searchsorted(self.days, stated.day))
            by_epoch[k].append(self.unknowns.dated(stated, x[k]))
        root = np.zeros((size, size + 1))
        root[range(size), range(size)] = 1.0 / self.u
        root[:, -1] = (self.mean - x[0]) / self.u
        passages = [
            replace(passage, gap=follows.whole @ before + shift - after)
            for (follows, shift, passage), before, after in zip(self.passages, x, x[1:], strict=False)
        ]
        none = np.zeros((0, size + 1))
        rows = [parts[0] if len(parts) == 1 else np.vstack([none, *parts]) for parts in by_epoch]
        return Linearised(root, rows, passages)

    def solved(self, start: Now | None) -> Estimate:
        """The estimate, from the passes of Gauss-Newton."""
        found = gauss_newton(self.lines_at, self.begun(start), follows=start is None, alike=not self.unsure)
        return Estimate(
            self.unknowns, self.records, self.noise, self.seen_degc, self.days, self.epoch_of, found.x,
            self.around(found.x), found.root, found.links, self.by_record, found.chi2, found.passes,
        )  # fmt: skip
