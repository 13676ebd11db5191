"""The fewest stops to what is wanted: found together, since the best first stop need not be one of the best four."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.estimate.next_stop import COVERAGE_FACTOR, Expected, Joint, Plan, Suggestion, Wanted
from calib.model import Array

SWEEPS = 6  # of exchanges; three settle it as a rule
TOGETHER = 16  # more stops are not exchanged: among so many the choice of one matters little


def stops_ahead(plan: Plan, joint: Joint, expected: Expected, wanted: Wanted, most: int) -> list[Suggestion]:
    """Stops until all is as wanted, as few as were found, `most` at most; each with the uncertainties after it.

    They keep the inclination of the clamp as long as they can. First each is the best next one; then a set of one fewer
    is searched, in which no exchange of a single stop gains, as long as such a set reaches what is wanted.
    """
    found = _one_by_one(plan, joint, expected, wanted, most)
    if not wanted.reached(found[-1].expanded if found else joint.expanded) or len(found) > TOGETHER:
        return found
    stops = [each.stop for each in found]
    while len(stops) > 1:
        for start in (stops[:-1], _spread(plan, joint, expected, len(stops) - 1)):
            fewer = _exchanged(plan, joint, expected, wanted, start)
            ordered = _in_order(plan, joint, expected, wanted, fewer)
            if wanted.reached(ordered[-1].expanded):
                break
        else:
            return found
        stops, found = fewer, ordered
    return found


def _one_by_one(plan: Plan, joint: Joint, expected: Expected, wanted: Wanted, most: int) -> list[Suggestion]:
    found: list[Suggestion] = []
    while len(found) < most and not wanted.reached(joint.expanded):
        best = plan.suggestions(joint, expected, wanted)[0]
        joint = plan.after(joint, best.stop, expected)
        found.append(replace(best, expanded=joint.expanded))
    return found


def _spread(plan: Plan, joint: Joint, expected: Expected, count: int) -> list[int]:
    """So many stops, each the one that tells most in all directions together (of the largest determinant)."""
    told, chosen = plan.information(joint, expected), list[int]()
    scale = np.sqrt(np.diag(joint.covariance))
    told = told * np.outer(scale, scale)
    total = np.linalg.inv(joint.covariance / np.outer(scale, scale))
    for _ in range(count):
        size = np.linalg.slogdet(total + told)[1]
        size[chosen] = -np.inf
        chosen.append(int(np.argmax(size)))
        total = total + told[chosen[-1]]
    return chosen


def _exchanged(plan: Plan, joint: Joint, expected: Expected, wanted: Wanted, stops: Sequence[int]) -> list[int]:
    """As many stops, none twice; exchanging any one of them for another does not gain."""
    told, chosen = plan.information(joint, expected), list(stops)
    scale = np.sqrt(np.diag(joint.covariance))
    told = told * np.outer(scale, scale)
    total = np.linalg.inv(joint.covariance / np.outer(scale, scale)) + told[chosen].sum(axis=0)
    free = np.array([k not in chosen for k in range(len(told))])
    for _ in range(SWEEPS):
        before = list(chosen)
        for place, stop in enumerate(chosen):
            free[stop], total = True, total - told[stop]
            cost = np.where(free, wanted.cost(_expanded(total + told, scale, joint.main)), np.inf)
            best = int(np.argmin(cost))
            chosen[place], free[best], total = best, False, total + told[best]
        if chosen == before:
            break
    return chosen


def _expanded(precision: Array, scale: Array, main: Array) -> Array:
    """(P, 9) of P precisions of quantities divided by `scale`."""
    variance = np.diagonal(np.linalg.inv(precision), axis1=1, axis2=2)[:, :9]
    return np.asarray(COVERAGE_FACTOR * np.sqrt(np.maximum(variance, 0.0)) * scale[:9] / main)


def _in_order(plan: Plan, joint: Joint, expected: Expected, wanted: Wanted, stops: Sequence[int]) -> list[Suggestion]:
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
