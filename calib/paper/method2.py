"""Method 2 (section 2.2): all three axes excited at once on the inclined clamp, main sensitivities only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.estimate.nuisances import Priors
from calib.model import Array
from calib.paper.amplitudes import AmplitudeCalibration, Ratios, Run, combine, ratios, read
from calib.paper.propagation import Contribution
from calib.paper.statistics import AXES, TRANSVERSE_LIMIT_PCT

# Along an axis with less of the motion than this, a transverse sensitivity counts five times: no main sensitivity then.
LEAST_SHARE = 0.2


def solve(
    runs: Sequence[Run], priors: Priors | None = None, transverse_limit_pct: float = TRANSVERSE_LIMIT_PCT
) -> AmplitudeCalibration:
    """S_xx, S_yy, S_zz in output unit per m/s2: Eq. (2) with the reference accelerations of Eqs. (5)-(7).

    S_ii = V_i / (a_ref d_i), d the pose's direction, the mean over runs and their cycles; axes with less than
    `LEAST_SHARE` of the motion in a run are not taken from it. Transverse sensitivities are not seen: each is taken to
    lie anywhere within +- `transverse_limit_pct` of the main one of its row (what the paper has verified by Method 1,
    see `calib.paper.statistics.transverse_excess`), and is in the uncertainty with that. Of the mean of two alphas,
    45 and 135 deg, only S_xz and S_zx are left. Raises ValueError where a run carries no sine or no axis is excited.
    """
    if not runs:
        raise ValueError("Method 2 needs at least one run")
    for run in runs:
        if run.pose.direction.shape != (3, 1):
            raise ValueError(f"position {run.pose.position}: Method 2 needs a uniaxial reference")
    found = [ratios(run) for run in runs]
    readings = [
        read(ratio, r, i, i, phase_of=i)
        for r, ratio in enumerate(found)
        for i in range(3)
        if abs(ratio.pose.direction[i, 0]) >= LEAST_SHARE
    ]
    main = np.array([np.mean([r.values.mean() for r in readings if r.i == i] or [np.nan]) for i in range(3)])
    unseen = unseen_transverse(main, found, transverse_limit_pct)
    return combine("2 (inclined clamp)", found, readings, priors or Priors(), unseen)


def unseen_transverse(main: Array, found: Sequence[Ratios], limit_pct: float) -> dict[str, Contribution]:
    """What transverse sensitivities at one standard uncertainty, limit / sqrt(3), put into the main ones.

    `main` (3,). S_ij enters S_ii by the mean of d_j / d_i over the runs that S_ii comes from.
    """
    directions = np.array([ratio.pose.direction[:, 0] for ratio in found])
    contributions = {}
    for i in range(3):
        kept = directions[np.abs(directions[:, i]) >= LEAST_SHARE]
        for j in range(3):
            if i != j and len(kept):
                change = np.full(12, np.nan)
                change[[0, 4, 8]] = 0.0
                change[4 * i] = limit_pct / 100 / np.sqrt(3) * abs(main[i]) * (kept[:, j] / kept[:, i]).mean()
                contributions[f"S{AXES[i]}{AXES[j]}"] = Contribution("transverse sensitivity, not seen", change)
    return contributions
