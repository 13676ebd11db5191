"""The fewest stops to what is wanted: found together, since the best first stop need not be one of the best four."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.visit.next_stop import COVERAGE_FACTOR, Expected, JointCovariance, Plan, Suggestion, WantedUncertainty

ALL_SETS = 20_000  # so many sets are all looked at: half a second
AT_ONCE = 2000  # sets whose covariances are in memory together
STARTS = 6  # spread sets from which exchanges begin, besides what was found one by one
SWEEPS = 6  # of exchanges; three settle it as a rule
TOGETHER = 16  # more stops are not exchanged: among so many the choice of one matters little


def stops_ahead(
    plan: Plan, joint: JointCovariance, expected: Expected, wanted: WantedUncertainty, most: int
) -> list[Suggestion]:
    """Stops until all is as wanted, as few as were found, `most` at most; each with the uncertainties after it.

    They keep the inclination of the clamp as long as they can. First each is the best next one. Then the best set of as
    many is searched, and of one fewer as long as such a set reaches what is wanted.
    """
    found = _one_by_one(plan, joint, expected, wanted, most)
    if not found or not wanted.reached(found[-1].expanded) or len(found) > TOGETHER:
        return found
    together, stops = StopSets(plan, joint, expected, wanted), [each.stop for each in found]
    best, expanded = together.best(stops)
    while len(best) > 1:
        fewer, expanded = together.best(best[:-1])
        if not wanted.reached(expanded):
            break
        best = fewer
    return _in_order(plan, joint, expected, wanted, best)


def _one_by_one(
    plan: Plan, joint: JointCovariance, expected: Expected, wanted: WantedUncertainty, most: int
) -> list[Suggestion]:
    found: list[Suggestion] = []
    while len(found) < most and not wanted.reached(joint.expanded):
        best = plan.suggestions(joint, expected, wanted)[0]
        joint = plan.after(joint, best.stop, expected)
        found.append(replace(best, expanded=joint.expanded))
    return found


class StopSets:
    """Sets of stops, none twice, with what each stop adds to the inverse of the covariance (P, N, N)."""

    def __init__(self, plan: Plan, joint: JointCovariance, expected: Expected, wanted: WantedUncertainty) -> None:
        joint = plan.shared(joint)
        self._scale, self._main, self._wanted = np.sqrt(np.diag(joint.covariance)), joint.main, wanted
        square = np.outer(self._scale, self._scale)
        self._known = np.linalg.inv(joint.covariance / square)
        self._told = plan.information(joint, expected) * square

    def best(self, start: Sequence[int]) -> tuple[list[int], Array]:
        """The best set of as many stops as `start` has, and U (9,) after it: of all sets, where they are few.

        Else of those to which exchanges lead from `start`, and from sets that tell most in all directions together.
        A stop is in a set once, unless there are fewer stops than that.
        """
        stops, count = len(self._told), len(start)
        if 0 < math.comb(stops, count) <= ALL_SETS:
            return self.of(itertools.combinations(range(stops), count))
        firsts = np.linspace(0, stops - 1, STARTS).round().astype(int) if count <= stops else ()
        starts = [list(start), *(self._spread(count, int(first)) for first in firsts)]
        return self.of(self._exchanged(some) for some in starts)

    def of(self, sets: Iterable[Sequence[int]]) -> tuple[list[int], Array]:
        """The best of these sets, and U (9,) after it."""
        found = [self._best_of(np.array(some)) for some in _batches(sets)]
        return min(found, key=lambda each: float(self._wanted.cost(each[1])))

    def _best_of(self, sets: NDArray[np.intp]) -> tuple[list[int], Array]:
        expanded = self._expanded(self._known + self._told[sets].sum(axis=1))
        k = int(np.argmin(self._wanted.cost(expanded)))
        return sets[k].tolist(), expanded[k]

    def _spread(self, count: int, first: int) -> list[int]:
        """So many stops: the first one, then each the one with which the determinant is the largest."""
        chosen, total = [first], self._known + self._told[first]
        while len(chosen) < count:
            size = np.linalg.slogdet(total + self._told)[1]
            size[chosen] = -np.inf
            chosen.append(int(np.argmax(size)))
            total = total + self._told[chosen[-1]]
        return chosen

    def _exchanged(self, stops: Sequence[int]) -> list[int]:
        """As many stops; exchanging any one of them for another does not gain."""
        told, chosen = self._told, list(stops)
        total = self._known + told[chosen].sum(axis=0)
        free = np.array([k not in chosen for k in range(len(told))])
        for _ in range(SWEEPS):
            before = list(chosen)
            for place, stop in enumerate(chosen):
                free[stop], total = True, total - told[stop]
                cost = np.where(free, self._wanted.cost(self._expanded(total + told)), np.inf)
                best = int(np.argmin(cost))
                chosen[place], free[best], total = best, False, total + told[best]
            if chosen == before:
                break
        return chosen

    def _expanded(self, precision: Array) -> Array:
        """(P, 9) of P precisions of quantities divided by their scale."""
        variance = np.diagonal(np.linalg.inv(precision), axis1=1, axis2=2)[:, :9]
        return np.asarray(COVERAGE_FACTOR * np.sqrt(np.maximum(variance, 0.0)) * self._scale[:9] / self._main)


def _in_order(
    plan: Plan, joint: JointCovariance, expected: Expected, wanted: WantedUncertainty, stops: Sequence[int]
) -> list[Suggestion]:
    """The stops, of which the one that gains most comes first, and then those of the same inclination."""
    left, found, theta_rad = list(stops), [], None
    while left:
        same = [k for k in left if plan.poses[k].theta_rad == theta_rad] or left
        best = next(s for s in plan.suggestions(joint, expected, wanted) if s.stop in same)
        joint = plan.after(joint, best.stop, expected)
        found.append(replace(best, expanded=joint.expanded))
        left.remove(best.stop)
        theta_rad = plan.poses[best.stop].theta_rad
    return found


def _batches(sets: Iterable[Sequence[int]]) -> Iterator[list[Sequence[int]]]:
    left = iter(sets)
    while some := list(itertools.islice(left, AT_ONCE)):
        yield some
