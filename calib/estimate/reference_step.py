"""A step that the reference could have made as well as the sensor: which change of S is the same in the windows.

A reference whose sensitivity is higher by the share r than assumed indicates more: with it S is wrong by r along the
directions that this reference drives, and the slopes of the windows are the same as without. Therefore the size of a
step of the sensor is uncertain by what the reference may have done, until something else tells S or the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.estimate.joint_state import JointState
from calib.estimate.quantities import REFERENCE_DRIFT
from calib.estimate.window_rows import Rows
from calib.model import Array

ALIKE = 1e-6  # relative: changes of S with smaller singular values were not excited
SIGNIFICANT = 3.0  # standard uncertainties of a step
SAME_SLOPES = 0.1  # of the effect of a step: if the change of S leaves more of it, the windows tell the two apart


@dataclass(frozen=True, slots=True, eq=False)
class Alike:
    """A change (N,) of the state that does not change the slopes of the windows: 1 in the drift with this key of a
    channel of a reference, and S as it must change with it. `u` is the standard uncertainty with which the windows tell
    S along it, relative."""

    key: str
    change: Array
    u: float

    def step(self, S: Array, drift: float) -> float:
        """Relative step along this change that the slopes show, when S changes by `S` (3, 3), the drift by `drift`;
        0 if it is not significant."""
        along = self.change[:9]
        step = float(along @ S.ravel() / (along @ along)) - drift
        return step if abs(step) > SIGNIFICANT * self.u else 0.0


def alike(windows: Sequence[Rows], state: JointState) -> list[Alike]:
    """One for each channel of a reference that drifts and moves in these windows; their rows, at the state.

    None for a channel whose step these windows tell from a change of S, because another reference moves in them too.
    """
    slopes = np.vstack([rows.jacobian[: rows.slopes] for rows in windows])
    found = []
    for k, quantity in enumerate(state.quantities):
        if quantity.kind is REFERENCE_DRIFT and slopes[:, k].any():
            change = np.zeros(len(state))
            change[k] = 1.0
            change[:9] = np.linalg.lstsq(slopes[:, :9], -slopes[:, k], rcond=ALIKE)[0]
            told, left = (float(np.linalg.norm(slopes[:, :n] @ change[:n])) for n in (9, len(state)))
            if left < SAME_SLOPES * told:
                found.append(Alike(quantity.key, change, 1.0 / told))
    return found
