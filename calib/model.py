"""The model V = S a + Q (Eq. 8 of D'Emilia et al. 2018) and the types for poses, windows and calibrations.

Units: accelerations in m/s2; outputs V in the sensor's own output unit; S in output unit per m/s2; Q in the output
unit. Each row of S belongs to an output axis, each column to a direction of the acceleration: S[0, 1] is S_xy, the
sensitivity of output x to an acceleration along y. Equation and section numbers in `calib` are those of that paper
(docs/paper.md) unless another source is named.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
PARAMETERS = ("Sxx", "Sxy", "Sxz", "Syx", "Syy", "Syz", "Szx", "Szy", "Szz", "Qx", "Qy", "Qz")


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """How the sensor stands: the directions of the motion and of gravity in the sensor's frame.

    The input acceleration in the sensor's frame is `a(t) = direction @ u(t) + gravity_mps2`, where u are the m channels
    of the reference in m/s2 (m = 0 at rest, 1 for a uniaxial reference, 3 for a tri-axial one).
    `position` names the pose: windows of one position share the errors of its angles and of its offset.
    `direction` is (3, m). `gravity_mps2` (3,) is what an ideal sensor reads at rest in this pose: zeros if the sensor
    does not measure gravity, NaN if it does but the gravity is not known; the mean of such a window is not used.
    `theta_rad`, `alpha_rad` are the angles of the clamp (Eqs. 9-11), None without a clamp. `u_alpha_rad`, `u_theta_rad`
    are the standard uncertainties of angles that were found from data; 0 for stated angles. `along` (m, m) is given
    when some channels were not excited by themselves (calib.windows.excited): the motion is then
    `direction @ (along @ u + along_rate_s @ du/dt)`, and the columns of those channels are zero in both matrices.
    """

    position: str
    direction: Array
    gravity_mps2: Array
    theta_rad: float | None = None
    alpha_rad: float | None = None
    u_alpha_rad: float = 0.0
    u_theta_rad: float = 0.0
    along: Array | None = None
    along_rate_s: Array | None = None

    @property
    def setting(self) -> tuple[object, ...]:
        """Poses with the same setting have the same nuisances, with the same effects."""
        angles = self.theta_rad, self.alpha_rad, self.u_theta_rad, self.u_alpha_rad
        return (self.position, self.direction.tobytes(), self.gravity_mps2.tobytes(), *angles)


class Slices(Protocol):
    """Rows that can be read from one number to another: an array, or rows on disk."""

    def __len__(self) -> int: ...

    def __getitem__(self, rows: slice, /) -> Any: ...


@dataclass(frozen=True, slots=True, eq=False)
class WindowSums:
    """Counts, means and centred sums of products of a window, one entry for each segment (half a second by default).

    Columns of z, q = 2 m + 3: the reference's m channels u, their m time derivatives du/dt, then V_x, V_y, V_z.
    `reference_channels` is m; `count` (K,) the number of samples of each segment; `mean` (K, q);
    `scatter` (K, q, q) = sum (z - mean)(z - mean)'. The sums are centred, so that no digits are lost to cancellation.
    Segments are merged by the formula of Chan, Golub and LeVeque (calib.windows.sums).
    """

    reference_channels: int
    count: Array
    mean: Array
    scatter: Array


@dataclass(frozen=True, slots=True, eq=False)
class BandSums:
    """Sums of products of a window in B bands of frequency (calib.windows.bands).

    `reference_channels` is m, integrals included. `low_hz`, `high_hz` (B,) are the limits of the bands, `points` (B,)
    the numbers of points in them, of which the share `independent` is statistically independent. `products`
    (B, 2 m + 3, 2 m + 3) are sums over points of products of u in m/s2, du/dt in m/s3 and V in output unit. `noise`
    (B, 2 m + 3) is the power of white noise. Where calib.windows.excited subtracted that of the reference from the
    products, it is still in the residuals. That of V is 0 where nothing tells it, and inf where all other noise is V's.
    `lasting` (B,): power of the motion that is there for half of the time, over its mean power.
    """

    reference_channels: int
    low_hz: Array
    high_hz: Array
    points: Array
    independent: float
    products: Array
    noise: Array
    lasting: Array


U_NOISE = 0.1  # of white noise that a spectrum of some hundred lines shows


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """One window of known excitation: its pose, its sums, and the verdict whether it is used.

    `start_s`, `stop_s` are the times of its first and last sample; `points` the number of samples in the sums,
    `left_out` the number of samples that were left out as knocks.
    `kind`: "motion" (the reference moved), "rest" (the sensor rested under a known gravity) or "quiet" (the reference
    hardly moved; the window is not used). `numbers` are the statistics behind the verdict, each with its unit in its
    name. `u_lag_s` is the standard uncertainty of this window's own lag, as far as the two clocks show it.
    `independent` is the share of statistically independent points: below 1 after both signals were limited to a band.
    `motion_hz`: the band of the motion that lasts, before anything was limited; None where `bands` tell it.
    `lag_bend` (2, 2 m, 3): what the slopes of V on u and du/dt are more, for one standard uncertainty of each of two
    independent parts of what is open of the lag within the window; None where that is nothing.
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
    u_noise: float = U_NOISE  # relative standard uncertainty of that noise as power
    bands: BandSums | None = None  # None at rest, and where no response over frequency is estimated
    response: tuple[float, ...] = ()  # terms (calib.signal.response) that were taken out; () where none were
    motion_hz: tuple[float, float] | None = None
    lag_bend: Array | None = None

    @property
    def silent_noise(self) -> Array:
        """(3,) noise of channels that were left out of the sums (calib.windows.excited): none were."""
        return np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """S and Q with their uncertainty.

    `sensitivity` (3, 3) in output unit per m/s2; `offset` (3,) in output unit; `covariance` (12, 12) in the order of
    PARAMETERS (S row by row, then Q). `determined` (12,) is true for each parameter that the data determine
    (calib.estimate.determined). The others have the posterior value if something was known of them before, as always on
    line, and are NaN if not.
    `degrees_of_freedom` are those of the type A part; inf if that part does not limit the coverage factor. `method`
    names the method for people.
    """

    sensitivity: Array
    offset: Array
    covariance: Array
    determined: NDArray[np.bool_]
    degrees_of_freedom: float
    method: str

    @property
    def standard_uncertainty(self) -> Array:
        """(12,) standard uncertainties: the square roots of the diagonal of the covariance."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def own_channels(channels: int) -> int:
    """Number of a reference's own channels: 0, 1 or 3. `channels` is 2 or 6 if their integrals follow them as well
    (calib.signal.corner)."""
    return {0: 0, 1: 1, 2: 1, 3: 3, 6: 3}[channels]


def scale_of(parameters: Array) -> float:
    """A sensor's scale in output unit per m/s2: root mean square of the main sensitivities in `parameters`, which begin
    with S row by row."""
    return float(np.sqrt(np.mean(parameters[[0, 4, 8]] ** 2)))
