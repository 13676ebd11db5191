"""Method 2 (section 2.2): all three axes excited at once on the inclined clamp, main sensitivities only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.estimate.nuisances import Priors
from calib.model import Array
from calib.paper.amplitudes import AmplitudeCalibration, Ratios, SineRun, combine, ratios, read
from calib.paper.propagation import Contribution
from calib.paper.statistics import AXES, TRANSVERSE_LIMIT_PCT

# Least component of the motion along an axis. With a smaller one, a transverse sensitivity would change the main
# sensitivity of this axis by five times its own value or more.
LEAST_SHARE = 0.2


def solve(
    runs: Sequence[SineRun], priors: Priors | None = None, transverse_limit_pct: float = TRANSVERSE_LIMIT_PCT
) -> AmplitudeCalibration:
    """S_xx, S_yy, S_zz in output unit per m/s2: Eq. (2) with the reference accelerations of Eqs. (5)-(7).

    S_ii = V_i / (a_ref d_i), where d is the direction of the pose; the mean over runs and their cycles. A run gives no
    value for an axis with less than `LEAST_SHARE` of the motion. Method 2 cannot measure transverse sensitivities. Each
    of them is assumed to lie within +- `transverse_limit_pct` of the main sensitivity of its row (rectangular
    distribution) and contributes to the uncertainty; Method 1 verifies this assumption (section 2.2, see
    `calib.paper.statistics.transverse_excess`). With the mean of alpha = 45 and 135 deg, only S_xz and S_zx contribute.
    Raises ValueError if a run has no sine or no axis is excited.
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
    """Contributions of the transverse sensitivities to the uncertainty of the main ones.

    The standard uncertainty of each is limit / sqrt(3) (rectangular, GUM 4.3.7). `main` (3,) are the main
    sensitivities. S_ij changes S_ii by the mean of d_j / d_i over the runs that give S_ii.
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
