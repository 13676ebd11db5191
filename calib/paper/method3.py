"""Method 3 as in the paper (section 2.3): linear least squares of Eq. (8) over all points, from the windows' sums."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.model import PARAMETERS, Array, Calibration, Pose, Window
from calib.windows.sums import factor

# Least singular value of an excited direction, relative to the largest (columns scaled to one). It is 3e-6 for clamp
# positions of 0, 1 and 2 deg; rounding errors alone give 1e-15.
RANK_TOLERANCE = 1e-10
PLAIN = "3 (plain)"  # the method's name in a calibration
# Largest u of a determined parameter, relative to the largest main sensitivity (docs/vocabulary.md).
DETERMINED_U = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A solution of plain Method 3 and the numbers that decide whether it is refused.

    `residual_sd` (3,) in output unit; `rank` of the matrix of all (a_x, a_y, a_z, 1): 4 if all 12 parameters can be
    determined; `condition` of the same matrix with its columns scaled to one; `points` used.
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
    """Least squares of Eq. (8) over all points of the used windows; agrees with `np.linalg.lstsq` to 1e-10.

    The covariance is type A for white residuals: the Kronecker product of the residual covariance of the outputs and
    (A'A)^-1. If the gravity of a window is not known, only its motion is used. Parameters that the points do not
    determine are NaN in S, Q and the covariance; all are NaN if there are no more points than unknowns. Raises
    ValueError if no window is used.
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
    np.fill_diagonal(residual, np.maximum(np.diag(residual), 0.0))  # rounding may make it negative for exact data
    spread = whitened @ whitened.T
    seen = _excited_columns(right[kept])
    calibration = _calibration(solution, residual, spread, seen, float(dof))
    condition = float(singular[0] / singular[-1]) if rank == design.shape[1] else float("inf")
    return Fit(calibration, np.sqrt(np.diag(residual)), rank, condition, points)


def refusal(found: Fit, windows: Sequence[Window]) -> list[str]:
    """The reasons why a solution is refused; empty if it is accepted.

    Either no parameter is determined, or the positions of the clamp leave a direction without excitation, as any two
    alphas with one theta do (section 2.3 requires four different input vectors).
    """
    if not found.calibration.determined.any():
        return [f"rank {found.rank} of 4: these windows determine no parameter; add positions or motion"]
    if found.rank < 4 and any(w.used and w.pose.alpha_rad is not None for w in windows):
        return [
            f"rank {found.rank} of 4: the clamp positions leave a direction without excitation; measure with at least "
            "three different alphas"
        ]
    return []


def _stack(windows: Sequence[Window]) -> tuple[Array, Array, Array, int, int]:
    """Stacked least-squares rows of all windows, their right-hand sides, the residual scatter (3, 3) within windows,
    the number of points, and the number of points less the means that are not used."""
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


def _excited_columns(rows: Array) -> NDArray[np.bool_]:
    """(4,) flags of the columns of (a_x, a_y, a_z, 1) that lie in the row space, so that they are determined."""
    return np.asarray(np.einsum("ij,ij->j", rows, rows) > 1.0 - 1e-9)


def _calibration(solution: Array, residual: Array, spread: Array, seen: NDArray[np.bool_], dof: float) -> Calibration:
    """The coefficients (4, 3) and their covariance in the order of PARAMETERS; NaN if not determined."""
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
