"""Method 1 (section 2.1): one axis along the motion, amplitude over amplitude (ISO 16063-21 and -31)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.estimate.nuisances import Priors
from calib.model import Pose
from calib.paper.amplitudes import AmplitudeCalibration, Run, combine, ratios, read

ON_AXIS = 1 - 1e-6  # cos of 0.08 deg, below what any mounting is known to: a stated direction that close is the axis


def solve(runs: Sequence[Run], priors: Priors | None = None) -> AmplitudeCalibration:
    """A column of S for each axis that was along the motion, the mean over its runs and their cycles.

    Eq. (2) main, S_jj = V_j / a_j; Eqs. (1), (3), (4) transverse, S_ij = V_i / a_j, signed by its phase against the
    main output (in phase: positive), its part in quadrature left out of S but not out of `magnitude`. S in output unit
    per m/s2. Columns that no run excited are NaN. Budget: reference, frequency, mounting (`angle` by position and
    `alpha_common`: first order in the transverse sensitivities, second in the main ones), motion across the axis.
    Raises ValueError where a pose has no axis along the motion or a run carries no sine.
    """
    if not runs:
        raise ValueError("Method 1 needs at least one run")
    axes = [excited_axis(run.pose) for run in runs]
    found = [ratios(run) for run in runs]
    readings = [
        read(ratio, r, i, j, phase_of=j) for r, (ratio, j) in enumerate(zip(found, axes, strict=True)) for i in range(3)
    ]
    return combine("1 (ISO 16063-21)", found, readings, priors or Priors())


def excited_axis(pose: Pose) -> int:
    """0, 1 or 2: the sensor's axis along the motion, either way round. Raises ValueError where none is."""
    if pose.direction.shape != (3, 1):
        raise ValueError(f"position {pose.position}: Method 1 needs a uniaxial reference")
    axis = int(np.argmax(np.abs(pose.direction)))
    if abs(pose.direction[axis, 0]) < ON_AXIS:
        text = ", ".join(f"{d:.4g}" for d in pose.direction[:, 0])
        raise ValueError(
            f"position {pose.position}: Method 1 needs one axis along the motion, the direction is ({text})"
        )
    return axis
