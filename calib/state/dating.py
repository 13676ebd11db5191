"""When a change came: the likelihood of its time, by all windows before and after it.

The solution is taken without the change, as two triangles at each epoch: what all earlier rows say of it, and what its
own and all later rows say. A change at the time t moves the unknowns behind t by

    D(t) w = F(t -> epoch) U w        w of unit variance

so that one small QR joins both triangles for a supposed time. Its chi-squared and its determinant are minus twice the
log-likelihood (Willsky and Jones 1976, with a prior of the size in place of its maximum). U has the change as all
windows found it, of which the size is free, or of a drift its rates: with all unknowns of a step free, noise alone
would explain a change next to the first or the last window. What changed by less than SIGNIFICANT standard
uncertainties did not change, unless nothing changed by more. Of windows that were merged over t, the record has
the change in the share of them that came later; how they were spread over its days nobody knows, so that within
these all times are alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import numpy as np

from calib.estimate.chain import Passage
from calib.estimate.determined import Flags
from calib.estimate.estimate import Estimate, Then
from calib.estimate.quantities import ALL_RATES, S_AND_Q
from calib.model import Array
from calib.signal.order_statistics import distinct
from calib.windows.record import Record

PROBABILITY = 0.95  # with which the interval of a date contains the time of the change
# Stretches of time with more than this of the whole probability, and their neighbours, are parted into FINE, again and
# again: of windows that were merged over the change, the share that came later is known well.
NEGLIGIBLE, FINE, ROUNDS = 1e-6, 48, 3
SIGNIFICANT = 3.0  # standard uncertainties of a change
ROUNDING = 1e-6  # standard uncertainties
APART_DAYS = 1e-9  # steps stand so near to a window


@dataclass(frozen=True, slots=True)
class Date:
    """When a change came: the mean `day`, its standard uncertainty in days, and an interval of days that contains it
    with PROBABILITY, with as much on either side. `by_windows`: windows tell it; else a statement does, and the change
    is anywhere between the windows before and after it."""

    day: float
    standard_uncertainty: float
    interval: tuple[float, float]
    by_windows: bool

    @classmethod
    def of(cls, edges: Array, probability: Array, *, by_windows: bool) -> Self:
        """From the probability (n,) of each stretch of time between `edges` (n + 1,), within which it is even.

        Raises ValueError where it is not finite.
        """
        if not (np.isfinite(edges).all() and np.isfinite(probability).all()):
            raise ValueError("the windows tell no time of a change")
        share = probability / probability.sum()
        middle, width = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
        mean = float(share @ middle)
        u = float(np.sqrt(share @ ((middle - mean) ** 2 + width**2 / 12.0)))
        reached = np.append(0.0, np.cumsum(share))
        low, high = np.interp([0.5 - 0.5 * PROBABILITY, 0.5 + 0.5 * PROBABILITY], reached, edges).tolist()
        return cls(mean, u, (low, high), by_windows)


def stated_date(records: Sequence[Record], day: float) -> Date:
    """Of a change that somebody stated: between the windows before and after it."""
    before = max((r.days[1] for r in records if r.day < day), default=day)
    after = min((r.days[0] for r in records if r.day >= day), default=day)
    return Date.of(np.array([before, max(before, after)]), np.ones(1), by_windows=False)


def date_of_change(whole: Estimate, then: Then, day: float, begin: float, end: float) -> Date:
    """Of the change that is stated to be on `day`, just after `then`, as the windows tell it: any time from `begin` to
    `end` is as likely beforehand."""
    ends = np.array([day for record in whole.records for day in record.days])
    edges = distinct(np.array([begin, end, *ends[(ends > begin) & (ends < end)]]))
    edges = edges[np.append(True, np.diff(edges) > APART_DAYS)]
    stated = {key: u for step in whole.unknowns.statements.steps if step.day == day for key, u in step.u.items()}
    cost = cache(_OnsetHypothesis(whole, day, _moves(then, stated)).cost)
    probability = _probability(cost, edges)
    for _ in range(ROUNDS):
        likely = np.asarray(probability > NEGLIGIBLE * probability.sum())
        near = likely | np.append(False, likely[:-1]) | np.append(likely[1:], False)
        parts = int(np.ceil(FINE / near.sum()))
        split = [
            np.linspace(before, after, parts + 1)[:-1] if alike else [before]
            for before, after, alike in zip(edges[:-1], edges[1:], near, strict=True)
        ]
        edges = np.append(np.concatenate(split), edges[-1])
        probability = _probability(cost, edges)
    return Date.of(edges, _even_in_merged(whole.records, edges, probability), by_windows=True)


def _even_in_merged(records: Sequence[Record], edges: Array, probability: Array) -> Array:
    """The same, even within each stretch over which windows were merged: when they were within it nobody knows."""
    first, last = (np.array([r.days[k] for r in records]) for k in (0, 1))
    middle, width = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    within: Flags = np.asarray(((first < middle[:, None]) & (middle[:, None] < last)).any(axis=1))
    stretch = np.cumsum(np.append(True, within[1:] != within[:-1]))
    found = probability.copy()
    for k in distinct(stretch[within]).tolist():
        own = stretch == k
        found[own] = width[own] * (probability[own].sum() / width[own].sum())
    return found


def _moves(then: Then, stated: Mapping[str, float]) -> Array:
    """U (N, m): of a drift each rate that changed, else the change that was found; where nothing was found, since no
    window came yet, what was `stated` of each parameter of S and Q."""
    unknowns, u = then.now.unknowns, np.linalg.norm(then.moved_factor, axis=1)
    rates = [unknowns.at[name] for name in ALL_RATES if name in stated]
    if rates:
        return np.diag(np.hypot(then.moved, u))[:, rates]
    found = np.abs(then.moved) > SIGNIFICANT * u
    if found.any():
        return np.where(found, then.moved, 0.0)[:, None]
    if (np.abs(then.moved) > ROUNDING * u).any():
        return then.moved[:, None]
    parameters = {quantity.key for quantity in S_AND_Q}
    return np.array(unknowns.stepped({key: size for key, size in stated.items() if key in parameters})).T


def _probability(cost: Callable[[float], float], edges: Array) -> Array:
    """(n,) that of each stretch between `edges` (n + 1,), up to a factor."""
    costs = np.array([cost(t) for t in (0.5 * (edges[1:] + edges[:-1])).tolist()])
    return np.asarray(np.diff(edges) * np.exp(-0.5 * (costs - costs.min())))


def _by_epoch(whole: Estimate) -> list[list[tuple[Record, Array]]]:
    """The records of each epoch, with their rows."""
    own: list[list[tuple[Record, Array]]] = [[] for _ in whole.days]
    for k, record, rows in zip(whole.epoch_of.tolist(), whole.records, whole.rows, strict=True):
        own[k].append((record, rows))
    return own


class _OnsetHypothesis:
    """The solution without a change, and what it costs to suppose the change at a time.

    A cost is chi-squared and the logarithm of the determinant of what is known, less a constant. `before` (K): the
    triangle of each epoch by all earlier rows; `after` (K): by its own rows and all later ones; each with its cost.
    """

    def __init__(self, whole: Estimate, day: float, moves: Array) -> None:
        """`day`: on which `whole` has the change; `moves` (N, m): U."""
        unknowns, steps = whole.unknowns, whole.unknowns.statements.steps
        others = [step for step in steps if step.day != day]
        self._moves = moves
        self._unknowns = unknowns.with_statements(replace(unknowns.statements, steps=others))
        self._days, self._x, size = whole.days, whole.x, len(unknowns)
        self._own = own = _by_epoch(whole)
        ends = [[record.days for record, _ in seen] or [(day, day)] for seen, day in zip(own, self._days, strict=True)]
        self._first = np.array([min(first for first, _ in days) for days in ends])
        self._last = np.array([max(last for _, last in days) for days in ends])
        self._passages = [self._passage(k) for k in range(len(self._days) - 1)]
        self._stretch = np.append(0.0, np.cumsum([-2.0 * np.linalg.slogdet(p.back)[1] for p in self._passages]))
        mean, u = self._unknowns.prior
        self._before = [(np.column_stack([np.diag(1.0 / u), (mean - self._x[0]) / u]), 0.0)]
        for k, passage in enumerate(self._passages):
            root, cost = self._before[k]
            root, more = _passed(np.vstack([root, self._rows(k)]), passage)
            self._before.append((root, cost + more))
        self._after = [(np.zeros((0, size + 1)), 0.0)]
        for k in range(len(self._days) - 1, -1, -1):
            root, cost = self._after[0]
            root, more = _returned(root, self._passages[k]) if len(root) else (root, 0.0)
            root, own_cost = _reduced(np.vstack([root, self._rows(k)]), 0)
            self._after.insert(0, (root, cost + more + own_cost))

    def _passage(self, k: int) -> Passage:
        follows, shift, passage = self._unknowns.passage(*self._days[k : k + 2].tolist())
        return replace(passage, gap=follows @ self._x[k] + shift - self._x[k + 1])

    def _rows(self, k: int, t: float | None = None) -> Array:
        """Those of an epoch: of its windows, and of a calibration that an operator put in force then. With a time of
        the change: (r, N + m + 1), with the derivatives by w."""
        size, many = len(self._unknowns), self._moves.shape[1]
        parts = [(rows, 0.0 if t is None else self._moved(record, t)) for record, rows in self._own[k]]
        for stated in self._unknowns.statements.dated:
            if int(np.searchsorted(self._days, stated.day)) == k:
                moved = 0.0 if t is None or stated.day < t else self._moved_at(stated.day, t)
                parts.append((self._unknowns.dated(stated, self._x[k]), moved))
        if t is None:
            return np.vstack([np.zeros((0, size + 1)), *(rows for rows, _ in parts)])
        wide = [np.column_stack([r[:, :-1], r[:, :-1] @ (d + np.zeros((size, many))), r[:, -1]]) for r, d in parts]
        return np.vstack([np.zeros((0, size + many + 1)), *wide])

    def _moved_at(self, day: float, t: float) -> Array:
        """D (N, m) on a day after a change at the time t."""
        return np.asarray(self._unknowns.passage(t, day)[0] @ self._moves)

    def _moved(self, record: Record, t: float) -> Array | float:
        """D (N, m) as a record has it: the mean of that of its windows, as if they were spread evenly over its days."""
        first, last = record.days
        if t > last:
            return 0.0
        if t <= first:
            return self._moved_at(record.day, t)
        later = np.ceil((record.windows - 1) * (last - t) / (last - first))
        return np.asarray(later / record.windows * self._moved_at(0.5 * (t + last), t))

    def cost(self, t: float) -> float:
        """What it costs to suppose the change at the time t."""
        size, many, count = len(self._unknowns), self._moves.shape[1], len(self._days)
        mixed = int(np.searchsorted(np.maximum.accumulate(self._last), t, side="right"))  # windows before, and after
        later = int(np.searchsorted(np.minimum.accumulate(self._first[::-1])[::-1], t))  # windows after it alone
        root, cost = self._before[mixed]
        joint = np.eye(size + many, size + many + 1)
        joint[:size, :size], joint[:size, -1] = root[:, :-1], root[:, -1]
        for k in range(mixed, later):
            joint = np.vstack([joint, self._rows(k, t)])
            if k < count - 1:
                joint, more = _passed(joint, _with_constants(self._passages[k], many))
                cost += more
        if later < count:
            root, more = self._after[later]
            moved = root[:, :-1] @ self._moved_at(float(self._days[later]), t)
            joint = np.vstack([joint, np.column_stack([root[:, :-1], moved, root[:, -1]])])
            cost += more
        _, more = _reduced(joint, size + many)
        return cost + more + float(self._stretch[min(later, count - 1)])


def _reduced(rows: Array, many: int) -> tuple[Array, float]:
    """Rows (r, M + 1) without the first `many` unknowns as a triangle, and what was eliminated costs."""
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    size = rows.shape[1] - 1
    cost = 2.0 * float(np.log(np.abs(triangle.diagonal()[:many])).sum())
    if len(triangle) > size:
        cost += float(triangle[size, -1] ** 2)
    return triangle[many:size, many:], cost


def _passed(root: Array, passage: Passage) -> tuple[Array, float]:
    """Rows (r, N + 1) of an epoch as the triangle of the next one, and its cost."""
    many = passage.noise.shape[1]
    through = root[:, :-1] @ passage.back
    moved = np.column_stack([-through @ passage.noise, through, root[:, -1] + through @ passage.gap])
    return _reduced(np.vstack([np.eye(many, moved.shape[1]), moved]), many)


def _returned(root: Array, passage: Passage) -> tuple[Array, float]:
    """Rows (r, N + 1) of an epoch as those of the epoch before it, and its cost."""
    many, of_next = passage.noise.shape[1], root[:, :-1]
    moved = np.column_stack([
        of_next @ passage.noise, of_next @ np.linalg.inv(passage.back), root[:, -1] - of_next @ passage.gap
    ])  # fmt: skip
    return _reduced(np.vstack([np.eye(many, moved.shape[1]), moved]), many)


def _with_constants(passage: Passage, many: int) -> Passage:
    """A passage with so many unknowns more, which do not change."""
    size = len(passage.gap)
    back = np.eye(size + many)
    back[:size, :size] = passage.back
    noise = np.vstack([passage.noise, np.zeros((many, passage.noise.shape[1]))])
    return Passage.of(back, np.append(passage.gap, np.zeros(many)), noise)
