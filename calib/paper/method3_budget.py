"""Uncertainty of plain Method 3 by the GUM: the effect of each nuisance on a least-squares solution without nuisances.

The adjustment (calib.estimate) estimates the nuisances and has smaller uncertainties. This is the budget of the method
as it is in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.estimate.nuisances import Applied, Priors
from calib.estimate.terms import Inputs, Nuisances
from calib.model import Array, Pose, Window
from calib.paper.method3 import Fit
from calib.paper.propagation import Contribution, MethodUncertainty, propagate
from calib.windows.sums import pool


def statement(fit: Fit, windows: Sequence[Window], priors: Priors) -> MethodUncertainty:
    """Contributions of all nuisances to `fit`, the plain solution of the used windows; type A for white residuals.

    Raises ValueError if the windows do not determine all of S, because the effect of an unknown element is not known.
    """
    used = [w for w in windows if w.used]
    model = _Model(fit, used)
    contributions = propagate(
        lambda inputs: model.solution(inputs, inputs.offset[model.pose_of]),
        Nuisances(model.poses, used[0].sums.reference_channels, priors, Applied()),
    )
    contributions |= _offsets_between_windows(model, priors.offset_mps2)
    calibration = fit.calibration
    return MethodUncertainty(
        contributions, calibration.standard_uncertainty, np.full(12, calibration.degrees_of_freedom)
    )


class _Model:
    """The least-squares problem of the windows, and the indications that changed inputs would cause."""

    def __init__(self, fit: Fit, windows: Sequence[Window]) -> None:
        S = fit.calibration.sensitivity
        if not np.isfinite(S).all():
            raise ValueError("the windows do not determine all of S")
        self._S, self._Q = S, np.nan_to_num(fit.calibration.offset)
        self._given = np.append(np.ones(9), np.where(np.isfinite(fit.calibration.offset), 1.0, np.nan))
        self.output_per_mps2 = float(np.abs(np.diag(S)).mean())
        names = list(dict.fromkeys(w.pose.position for w in windows))
        first: dict[str, Pose] = {w.pose.position: w.pose for w in reversed(windows)}
        self.poses = [first[name] for name in names]
        self.pose_of = [names.index(w.pose.position) for w in windows]
        self.windows = windows
        m = windows[0].sums.reference_channels
        whole = [pool(w.sums) for w in windows]
        scatter = np.array([s.scatter[0] for s in whole])
        self._root_count = np.sqrt([float(s.count[0]) for s in whole])
        self._mean_u = np.array([s.mean[0, :m] for s in whole])
        values, vectors = np.linalg.eigh(scatter[:, :m, :m])
        self._root_u = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)  # (W, m, m)
        power = [(np.trace(each[m : 2 * m, m : 2 * m]), np.trace(each[:m, :m])) for each in scatter]
        self._omega = np.sqrt([fast / slow if slow > 0 else 1.0 for fast, slow in power])
        gravity = np.array([w.pose.gravity_mps2 for w in windows])
        self._known = np.isfinite(gravity).all(axis=1)
        self._inverse = np.linalg.pinv(self._rows(np.array([w.pose.direction for w in windows]), gravity))

    def solution(self, inputs: Inputs, offset: Array) -> Array:
        """(12,) result of plain Method 3 for the true `inputs` and an `offset` (W, 3) of each window in m/s2."""
        direction, gravity = inputs.direction[self.pose_of], inputs.gravity[self.pose_of]
        rows = self._rows(direction, gravity)
        passed = self._in_phase(inputs)  # (W, 3)
        indications = rows @ np.vstack([self._S.T, self._Q])
        moving = np.einsum("wrm,wkm,ik->wri", self._root_u, direction, self._S) * passed[:, None, :]
        indications[len(offset) :] = moving.reshape(-1, 3)
        indications[: len(offset)] += np.where(
            self._known[:, None], self._root_count[:, None] * self.output_per_mps2 * offset, 0.0
        )
        x = self._inverse @ indications
        return np.asarray(np.append(x[:3].T.ravel(), x[3]) * self._given)

    def _rows(self, direction: Array, gravity: Array) -> Array:
        """Least-squares rows on (a_x, a_y, a_z, 1): first the means of the windows, then their motion."""
        steady = np.einsum("wkm,wm->wk", direction, self._mean_u) + np.nan_to_num(gravity)
        means = np.column_stack([steady, np.ones(len(steady))]) * (self._root_count * self._known)[:, None]
        moving = np.einsum("wrm,wkm->wrk", self._root_u, direction).reshape(-1, 3)
        return np.vstack([means, np.column_stack([moving, np.zeros(len(moving))])])

    def _in_phase(self, inputs: Inputs) -> Array:
        """(W, 3) the part of the indications in phase with the reference; Method 3 uses only this part."""
        omega = self._omega[:, None]
        sensor, reference = (1 - 1j * c / omega for c in (inputs.sensor_corner, inputs.reference_corner))
        return np.asarray((np.exp(-1j * omega * inputs.lag_s) * reference / sensor).real)


def _offsets_between_windows(model: _Model, u_mps2: float) -> dict[str, Contribution]:
    """Contributions of an independent offset of each window and axis, with the standard uncertainty `u_mps2`."""
    if u_mps2 == 0.0:
        return {}
    still = Nuisances(model.poses, model.windows[0].sums.reference_channels, Priors.none(), Applied()).at(np.zeros(0))
    none = np.zeros((len(model.windows), 3))
    before = model.solution(still, none)
    found = {}
    for w in range(len(none)):
        for i in range(3):
            moved = none.copy()
            moved[w, i] = u_mps2
            change = model.solution(still, moved) - before
            found[f"offset_{'xyz'[i]} of window {w}"] = Contribution("offset between windows", change)
    return found
