"""Whether a mount turns against gravity."""

from __future__ import annotations

import numpy as np

from calib.model import Array, Window

LEAST_TURN_MPS2 = 0.5  # between mean input accelerations: a mount that leans by 3 deg


def mean_input(window: Window) -> Array:
    """(3,) mean input acceleration of a window by its pose as stated; NaN where nobody stated gravity."""
    sums, pose = window.sums, window.pose
    mean = sums.count @ sums.mean[:, : pose.direction.shape[1]] / sums.count.sum()
    return np.asarray(pose.gravity_mps2 + pose.direction @ mean)


def never_turned(inputs: Array) -> bool:
    """Whether mean input accelerations (W, 3) are those of a mount that never turns against gravity.

    The means of V then tell Q + S G alone: they determine Q once S is known, and no part of S.
    """
    known = inputs[np.isfinite(inputs).all(axis=1)]
    return bool(len(known) and (np.linalg.norm(known - known[0], axis=1) <= LEAST_TURN_MPS2).all())
