"""The model V = S a + Q (Eq. 8), what a window of data is, and what a calibration says.

Units: accelerations in m/s2; outputs V in the sensor's own output unit; S in output unit per m/s2; Q in the output
unit. S has a row an output axis and a column a direction, so S[0, 1] is S_xy: output x, excited along y.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
PARAMETERS = ("Sxx", "Sxy", "Sxz", "Syx", "Syy", "Syz", "Szx", "Szy", "Szz", "Qx", "Qy", "Qz")


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """How the sensor stands: what its ideal twin would read.

    The input acceleration in the sensor's frame is `a(t) = direction @ u(t) + gravity_mps2`, u being the reference's
    m channels in m/s2 (m = 0 at rest, 1 for a uniaxial reference, 3 for a tri-axial one).
    `direction` is (3, m); `gravity_mps2` (3,) is what an ideal sensor reads at rest there (zeros where the sensor or
    the equation does not feel it; NaN where a sensor feels a gravity that nobody stated: such a window's mean then says
    nothing). `theta_rad`, `alpha_rad` are kept where the pose came from the clamp (Eqs. 9-11).
    `position` names the pose: windows of one position share its angle and offset errors. `u_alpha_rad`, `u_theta_rad`
    are standard uncertainties of angles that were found, by position; 0 where they were stated. `along` (m, m) where
    some channels only move along with others: the motion is then `direction @ along @ u`, their columns zero.
    """

    position: str
    direction: Array
    gravity_mps2: Array
    theta_rad: float | None = None
    alpha_rad: float | None = None
    u_alpha_rad: float = 0.0
    u_theta_rad: float = 0.0
    along: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class WindowSums:
    """Additive summary of a window on the reference's own basis, one entry a segment (a cycle, or a second).

    Columns of z, q = 2 m + 3: the reference's m channels u, their m time derivatives du/dt, then V_x, V_y, V_z.
    `count` (K,) samples; `mean` (K, q); `scatter` (K, q, q) = sum (z - mean)(z - mean)'. Centred, so that nothing is
    lost to cancellation; merged by Chan's formula (calib.excitation.sums).
    """

    reference_channels: int
    count: Array
    mean: Array
    scatter: Array


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """One window of known excitation: where the sensor stood, its sums, and the verdict on it.

    `kind`: the reference moved, the sensor rested under a known gravity, or the reference was calm (not used by itself;
    it measures the noise of the reference). `numbers` are the statistics behind the verdict, unit in the name.
    `u_lag_s`: by how much this window's lag may differ from the others', as the two clocks tell. `independent`: the
    share of its points that are, less than 1 where both signals were limited to a band.
    """

    start_s: float
    stop_s: float
    pose: Pose
    sums: WindowSums
    used: bool
    reason: str  # why it is not used, "" where it is
    points: int
    left_out: int
    kind: Literal["motion", "rest", "quiet"] = "motion"
    numbers: Mapping[str, float] = field(default_factory=dict)
    u_lag_s: float = 0.0
    independent: float = 1.0
    reference_noise: Array | None = None  # (2, m) rms of the reference's own noise in u, m/s2, and in du/dt, m/s3


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """S and Q with what is known of them.

    `covariance` (12, 12) in the order of PARAMETERS (S row by row, then Q); `determined` (12,) tells which of the
    parameters the data support; the others carry NaN in files' estimates, the prior's value in an agent.
    `degrees_of_freedom` of the type A part, inf where it does not matter.
    """

    sensitivity: Array
    offset: Array
    covariance: Array
    determined: NDArray[np.bool_]
    degrees_of_freedom: float
    method: str

    @property
    def standard_uncertainty(self) -> Array:
        """(12,) square roots of the covariance's diagonal."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def own_channels(channels: int) -> int:
    """Channels of a reference itself: 1 or 3, where their integrals follow them (2 or 6) as well."""
    return {0: 0, 1: 1, 2: 1, 3: 3, 6: 3}[channels]
