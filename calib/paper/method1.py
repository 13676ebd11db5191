"""Method 1 (section 2.1): one axis along the motion, amplitude over amplitude (ISO 16063-21 and -31)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.estimate.nuisances import Priors
from calib.model import Pose
from calib.paper.amplitudes import AmplitudeCalibration, SineRun, combine, ratios, read

ON_AXIS = 1 - 1e-6  # cosine of 0.08 deg, smaller than the uncertainty of any mounting


def solve(runs: Sequence[SineRun], priors: Priors | None = None) -> AmplitudeCalibration:
    """A column of S for each axis that was along the motion: the mean over its runs and their cycles.

    Main sensitivities by Eq. (2), S_jj = V_j / a_j; transverse ones by Eqs. (1), (3) and (4), S_ij = V_i / a_j. Their
    sign is positive if output i is in phase with the main output; the part in quadrature counts in `magnitude` only. S
    is in output unit per m/s2; columns that no run excited are NaN. The budget has the reference, the frequency, the
    mounting (`angle` by position and `alpha_common`: first order in the transverse sensitivities, second order in the
    main ones) and transverse motion. Raises ValueError if a pose has no axis along the motion or a run has no sine.
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
    """The sensor's axis along the motion, in either sense: 0, 1 or 2. Raises ValueError if there is none."""
    if pose.direction.shape != (3, 1):
        raise ValueError(f"position {pose.position}: Method 1 needs a uniaxial reference")
    axis = int(np.argmax(np.abs(pose.direction)))
    if abs(pose.direction[axis, 0]) < ON_AXIS:
        text = ", ".join(f"{d:.4g}" for d in pose.direction[:, 0])
        raise ValueError(
            f"position {pose.position}: Method 1 needs one axis along the motion, the direction is ({text})"
        )
    return axis
