"""The innovation: the difference between a window and the prediction of the state, before the window is taken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.model import Array

TELLS = 1e-6  # least information of a window on a parameter, relative to that of the state


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """The statistics of the innovation of one window.

    If the state and its uncertainty are right, `statistic` is chi-squared with `degrees_of_freedom`, and `score` (12,),
    the innovation projected on each parameter of S and Q, is standard normal. A score is NaN if the window has no
    information on the parameter. A change d of a parameter changes the mean of its score by d sqrt(`information`);
    `information` (12,).
    """

    statistic: float
    degrees_of_freedom: int
    score: Array
    information: Array


def innovation(rows: Array, d: Array, factor: Array) -> Innovation:
    """The innovation of a window's rows (r, N + 1) against deviations d (N,) with this factor (N, N) of covariance."""
    jacobian = rows[:, :-1]
    residual = rows[:, -1] - jacobian @ d
    a = jacobian @ factor
    covariance = a @ a.T + np.eye(len(a))
    own = jacobian[:, :12]
    weighed = np.linalg.solve(covariance, np.column_stack([residual, own]))
    information = np.einsum("rp,rp->p", own, weighed[:, 1:])
    variance = np.einsum("ij,ij->i", factor[:12], factor[:12])
    tells = information * variance > TELLS
    root = np.sqrt(np.where(tells, information, 1.0))
    score = np.where(tells, own.T @ weighed[:, 0] / root, np.nan)
    return Innovation(float(residual @ weighed[:, 0]), len(a), score, np.where(tells, information, 0.0))
