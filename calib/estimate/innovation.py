"""What a window says against a state before it is taken: a test of consistency, and a score for each parameter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.estimate.joint_state import JointState
from calib.estimate.window_rows import Rows
from calib.model import Array

TELLS = 1e-6  # of the prior's own information on a parameter, that a window must bring to say anything of it


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """What a window says against the state, before it is taken.

    `statistic` is chi-squared with `degrees_of_freedom` if the state and its uncertainty are true. `score` (12,) is the
    innovation projected on each parameter, standard normal likewise, NaN where the window says nothing of it; a change
    d of the parameter moves it by d sqrt(`information`).
    """

    statistic: float
    degrees_of_freedom: int
    score: Array
    information: Array


def innovation(rows: Rows, state: JointState) -> Innovation:
    """The innovation of a window's rows, linearised at the state's mean."""
    a = rows.jacobian @ state.factor
    covariance = a @ a.T + np.eye(len(a))
    own = rows.jacobian[:, :12]
    weighed = np.linalg.solve(covariance, np.column_stack([rows.residual, own]))
    information = np.einsum("rp,rp->p", own, weighed[:, 1:])
    tells = information * state.variance[:12] > TELLS
    root = np.sqrt(np.where(tells, information, 1.0))
    score = np.where(tells, own.T @ weighed[:, 0] / root, np.nan)
    statistic = float(rows.residual @ weighed[:, 0])
    return Innovation(statistic, len(a), score, np.where(tells, information, 0.0))
