"""Method 3 as printed (section 2.3): linear least squares of Eq. (8) over all points of the windows, by their sums."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.excitation.sums import factor
from calib.model import PARAMETERS, Array, Calibration, Pose, Window

# Below this part of the largest singular value (columns scaled to one) a direction was not excited: positions 0/1/2 deg
# stand at 3e-6, what rounding alone leaves of an unseen direction at 1e-15.
RANK_TOLERANCE = 1e-10
PLAIN = "3 (plain)"  # what a calibration says of its method
# Without a prior a parameter counts as determined up to this u, as a part of the largest main sensitivity (contract).
DETERMINED_U = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A plain Method 3 solution with what its refusal needs.

    `residual_sd` (3,) in output units; `rank` of the points on (a_x, a_y, a_z, 1), 4 where all 12 parameters can
    be had; `condition` of the same with its columns scaled to one; `points` used.
    """

    calibration: Calibration
    residual_sd: Array
    rank: int
    condition: float
    points: int


def solve(windows: Sequence[Window]) -> Calibration:
    """S and Q of Eq. (8) by least squares over all points of the used windows; see `fit`."""
    return fit(windows).calibration


def fit(windows: Sequence[Window]) -> Fit:
    """Least squares over all points of the used windows, one of `np.linalg.lstsq` on the points to 1e-10.

    The covariance is type A for white residuals: residual covariance of the outputs (x) (A'A)^-1. A window whose
    gravity is not known gives its motion only. Parameters that the points do not determine are NaN, in S, Q and
    covariance; so are all where no point is left over to measure the residual.
    Raises ValueError where no window is used.
    """
    used = [w for w in windows if w.used]
    if not used:
        raise ValueError("no window is used")
    design, rhs, scatter, points, free = _stack(used)
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0.0] = 1.0
    left, singular, right = np.linalg.svd(design / scale, full_matrices=False)
    kept = singular > RANK_TOLERANCE * singular[0]
    rank = int(kept.sum())
    whitened = right[kept].T / singular[kept] / scale[:, None]
    solution = whitened @ (left[:, kept].T @ rhs)
    rest = rhs - design @ solution
    dof = free - rank
    residual = (scatter + rest.T @ rest) / dof if dof > 0 else np.full((3, 3), np.nan)
    np.fill_diagonal(residual, np.maximum(np.diag(residual), 0.0))  # of exact data rounding may leave less than nothing
    spread = whitened @ whitened.T
    seen = _seen(right[kept])
    calibration = _calibration(solution, residual, spread, seen, float(dof))
    condition = float(singular[0] / singular[-1]) if rank == design.shape[1] else float("inf")
    return Fit(calibration, np.sqrt(np.diag(residual)), rank, condition, points)


def refusal(found: Fit, windows: Sequence[Window]) -> list[str]:
    """Why the points cannot be used, empty where they can: nothing determined, or a clamp's positions that leave a
    direction unseen (with one theta any two alphas do, section 2.3)."""
    if not found.calibration.determined.any():
        return [f"rank {found.rank} of 4: no parameter is determined by these windows"]
    if found.rank < 4 and any(w.used and w.pose.alpha_rad is not None for w in windows):
        return [
            f"rank {found.rank} of 4: the clamp's positions leave a direction unseen; three alphas or more are needed"
        ]
    return []


def _stack(windows: Sequence[Window]) -> tuple[Array, Array, Array, int, int]:
    """Rows R_w M_w of all windows, their right-hand sides, the scatter within windows, points, and rows that count."""
    rows, rhs, scatter, points, free = [], [], np.zeros((3, 3)), 0, 0
    for window in windows:
        part = factor(window.sums)
        known = not np.isnan(window.pose.gravity_mps2).any()
        first = 0 if known else 1
        rows.append(part.r[first:, first:] @ _to_parameters(window.pose)[first:])
        rhs.append(part.rhs[first:])
        scatter += part.residual
        points += int(part.count)
        free += int(part.count) - first
    return np.concatenate(rows), np.concatenate(rhs), scatter, points, free


def _to_parameters(pose: Pose) -> Array:
    """(m + 1, 4): the window's basis [1, u] in terms of (a_x, a_y, a_z, 1)."""
    m = pose.direction.shape[1]
    return np.vstack([np.append(pose.gravity_mps2, 1.0), np.hstack([pose.direction.T, np.zeros((m, 1))])])


def _seen(rows: Array) -> NDArray[np.bool_]:
    """(4,) which of (a_x, a_y, a_z, 1) lie wholly in the row space; the others are free along the null space."""
    return np.asarray(np.einsum("ij,ij->j", rows, rows) > 1.0 - 1e-9)


def _calibration(solution: Array, residual: Array, spread: Array, seen: NDArray[np.bool_], dof: float) -> Calibration:
    """Arrange (4, 3) coefficients and their covariance in the order of PARAMETERS; NaN what is not determined."""
    order = [(i, j) for i in range(3) for j in range(3)] + [(i, 3) for i in range(3)]
    output, column = np.array(order).T
    covariance = residual[np.ix_(output, output)] * spread[np.ix_(column, column)]
    determined = seen[column]
    main = np.abs(np.diag(solution[:3]))[seen[:3]]
    limit = DETERMINED_U * float(main.max()) if main.size else np.inf
    determined &= np.sqrt(np.maximum(np.diag(covariance), 0.0)) <= limit
    values = np.where(determined, solution[column, output], np.nan)
    covariance = np.where(np.outer(determined, determined), covariance, np.nan)
    assert len(order) == len(PARAMETERS)
    return Calibration(values[:9].reshape(3, 3), values[9:], covariance, determined, dof, PLAIN)
