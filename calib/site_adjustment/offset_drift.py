"""Q that drifts within a meeting of two devices: a random walk of the mean output, beside the scatter of each window.

Nobody states how large the drift is. It is found from what an adjustment with a constant Q leaves of the means of each
output: for many variances of the walk and of the scatter, averaged with the likelihood of each, as in
calib.adjustment.norm_fit. The walk counts only if scatter alone would show as much once in a hundred meetings. Then its
most likely course is taken out of the means, so that an adjustment of them gives the S and Q of generalised least
squares (Henderson 1975, Biometrics 31). Q is that in the middle of the meeting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.adjustment.adjustment import Adjustment
from calib.adjustment.norm_fit import WALKS, walk_steps
from calib.model import Array, Window

# Scatter alone shows more than this once in a hundred meetings: three outputs together, each of which shows no walk in
# every other meeting, because a variance is not below 0 (Self and Liang 1987).
LEAST_CHI2 = 8.7
# Variances of the scatter, in that which the adjustment gives the means: from the stated one on, because noise that is
# slow within a window makes the adjustment give too large ones.
LEAST_SCATTER, MOST_SCATTER, SCATTERS = 1e-3, 1e2, 13
ROUNDING = 1e-12  # of what is known in a direction of y, which is 1


@dataclass(frozen=True, slots=True, eq=False)
class OffsetDrift:
    """What the drift did: `output` (W, 3) added to the mean output of each window, in output unit; `covariance` (N, N)
    that it adds to that of [S, Q, nuisances], with the walk from the middle of the meeting to its begin or end."""

    output: Array
    covariance: Array

    def removed_from(self, windows: Sequence[Window]) -> list[Window]:
        """The windows as they would be if Q had stayed as it is in the middle of the meeting."""
        found = []
        for window, output in zip(windows, self.output, strict=True):
            mean = window.sums.mean.copy()
            mean[:, -3:] -= output
            found.append(replace(window, sums=replace(window.sums, mean=mean)))
        return found


def drift_of(found: Adjustment, windows: Sequence[Window]) -> OffsetDrift | None:
    """The drift that the windows show beside the adjustment of them; None if they show none.

    `windows` are those that were adjusted, in the same order.
    """
    solution, equations = found.grounds.solution, found.grounds.solution.equations
    known = np.flatnonzero(equations.known)  # of the others the mean tells nothing
    time_s = np.array([0.5 * (w.start_s + w.stop_s) for w in windows])[known]
    if not (len(known) and np.ptp(time_s) > 0.0):
        return None
    left, rows = (equations.split(part)[1][known] for part in (solution.residual, solution.jacobian))
    weight, stated = equations.mean_weight[known], 1.0 - equations.white_share[known].mean(axis=0)
    unit = np.mean(weight**2, axis=0)  # 1 / output unit squared
    moved = walk_steps((time_s - 0.5 * (time_s.max() + time_s.min())) / np.ptp(time_s))
    courses = [
        _course(left[:, i], rows[:, i], weight[:, i, None] / np.sqrt(unit[i]) * moved, float(stated[i]))
        for i in range(3)
    ]
    if sum(course.chi2 for course in courses) <= LEAST_CHI2:
        return None
    output = np.zeros(equations.mean_weight.shape)
    output[known] = np.transpose([course.walk for course in courses]) / weight
    covariance = solution.half @ np.sum([course.more for course in courses], axis=0) @ solution.half.T
    covariance[range(9, 12), range(9, 12)] += 0.5 * np.array([course.variance for course in courses]) / unit
    return OffsetDrift(output, covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _OffsetWalk:
    """The most likely walk (W,) of one output, and by how much the best walk improves chi-squared over none.

    `variance` of the walk over the whole time; `more` (N, N): by how much it enlarges the covariance of y, where
    x = found + half y. All in units of the scatter that the adjustment gives the means.
    """

    walk: Array
    chi2: float
    variance: float
    more: Array


def _course(left: Array, rows: Array, moved: Array, stated: float) -> _OffsetWalk:
    """The walk that the means of one output show.

    `left` (W,) is what the adjustment leaves of the means, `rows` (W, N) are those of y; `moved` (W, R) is what the R
    independent steps of a walk whose variance over the whole time is 1 do to the means; `stated` is the variance of the
    scatter as stated. All in units of the scatter that the adjustment gives the means.
    """
    size, seen = np.linalg.eigh(rows.T @ rows)
    seen = seen[:, size > ROUNDING]  # the directions of y that the means of this output tell of
    rows = rows @ seen
    ways, root, _ = np.linalg.svd(moved, full_matrices=False)  # along `ways` the walk is independent
    left_along, rows_along = ways.T @ left, ways.T @ rows
    scatters = np.geomspace(max(stated, LEAST_SCATTER), MOST_SCATTER, SCATTERS)
    scatter, ratio = (each.ravel() for each in np.meshgrid(scatters, WALKS, indexing="ij"))
    walked = ratio[:, None] * root**2 / (1.0 + ratio[:, None] * root**2)  # (G, R) share of the walk in the variance
    less, weight = walked / scatter[:, None], 1.0 / scatter

    square = rows.T @ rows
    lost = np.swapaxes(less[..., None] * rows_along, 1, 2) @ rows_along
    inverse = np.linalg.inv(np.eye(len(square)) + (weight - 1.0)[:, None, None] * square - lost)
    pull = (weight - 1.0)[:, None] * (left @ rows) - (less * left_along) @ rows_along
    step = (inverse @ pull[..., None])[..., 0]
    chi2 = weight * (left @ left) - less @ left_along**2 - np.sum(pull * step, axis=1)
    determinant = len(left) * np.log(scatter) - np.log1p(-walked).sum(axis=1) - np.linalg.slogdet(inverse)[1]
    likelihood = -0.5 * (chi2 + determinant)
    share = np.exp(likelihood - likelihood.max())
    share /= share.sum()
    apart = step - share @ step
    still = np.repeat(inverse[ratio == 0.0], len(WALKS), axis=0)  # with the same scatter, but without a walk
    return _OffsetWalk(
        walk=ways @ np.sum(share[:, None] * walked * (left_along - step @ rows_along.T), axis=0),
        chi2=2.0 * float(likelihood.max() - likelihood[ratio == 0.0].max()),
        variance=float(share @ (scatter * ratio)),
        more=seen @ (np.tensordot(share, inverse - still, 1) + (share[:, None] * apart).T @ apart) @ seen.T,
    )
