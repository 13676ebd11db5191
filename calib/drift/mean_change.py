"""What a change of the mean output of a mounted sensor may be: gravity is a witness of its own.

The mean is gravity g through S and Q, divided by the calibration in force. With d the change of this corrected mean:

- Q of any axis changes: d is any vector;
- the mount tilts by the small vector phi: d = phi x g, so that d is at right angles to g;
- the sensitivity of output i changes by the share e: d = e (S g)_i times column i of S^-1, which is about axis i.

Nothing is seen of a sensitivity along an axis that is nearly level, of a turn about gravity, or of transverse
sensitivities, and a mean alone never tells Q from the other two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.distributions import chi2_quantile
from calib.geometry import AXES
from calib.model import Array

FALSE = 1e-6  # chance that a sound mean is said to have changed, where its scatter is known
AGREES = 1e-3  # chance that what has happened is not named
LEAST_PART = 0.1  # of gravity along an axis, for a word on its sensitivity
LEAST_GRAVITY_MPS2 = 5.0  # a sensor that does not feel gravity has a smaller mean
COVERAGE_FACTOR = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class MeanChange:
    """A change (3,) of the mean in m/s2, its standard uncertainty (3,), and whether it is no chance.

    `tilt_rad`, `sensitivity`: value and standard uncertainty where the change may be a tilt, or that of the sensitivity
    of one output, as a share, by axis; empty where it contradicts them. `unseen`: axes with hardly any gravity.
    """

    change: Array
    u: Array
    significant: bool
    tilt_rad: tuple[float, float] | None
    sensitivity: dict[str, tuple[float, float]]
    unseen: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """In a sentence; "" where nothing has changed."""
        if not self.significant:
            return ""
        change, U = _numbers(self.change), _numbers(COVERAGE_FACTOR * self.u)
        may = ["Q by as much"]
        if self.tilt_rad is not None:
            tilt, u = np.degrees(self.tilt_rad)
            may.append(f"a tilt of the mount by {tilt:.2g}° ± {COVERAGE_FACTOR * u:.1g}°")
        for axis, (share, u) in self.sensitivity.items():
            may.append(f"the sensitivity of {axis} by {100.0 * share:+.2g} % ± {100.0 * COVERAGE_FACTOR * u:.1g} %")
        which = " or ".join(may) + (
            "; the mean cannot tell which" if len(may) > 1 else ", and neither a tilt nor one axis"
        )
        blind = f"; the sensitivity of {' and '.join(self.unseen)} is not seen there" if self.unseen else ""
        return f"the mean has changed by {change} m/s² (U {U}): {which}{blind}"


def mean_change(change: Array, covariance: Array, gravity_mps2: Array, sensitivity: Array) -> MeanChange | None:
    """What a change (3,) with its covariance (3, 3) may be, where the mean was `gravity_mps2` (3,) before, by the
    calibration in force with `sensitivity` (3, 3).

    None where gravity is not felt, or nothing is known of the scatter.
    """
    g = float(np.linalg.norm(gravity_mps2))
    u = np.sqrt(covariance.diagonal())
    if not g >= LEAST_GRAVITY_MPS2 or not np.isfinite(change).all() or not (u > 0.0).all():
        return None
    weight = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    significant = float(change @ weight @ change) > chi2_quantile(1.0 - FALSE, 3.0)
    up = gravity_mps2 / g
    level = np.linalg.svd(up[None])[2][1:].T  # (3, 2) at right angles to gravity
    moved, covered, rest = _fit(level, change, weight)
    tilt = None
    if rest <= chi2_quantile(1.0 - AGREES, 1.0):
        size = float(np.linalg.norm(moved))
        toward = moved / size if size else np.array([1.0, 0.0])
        tilt = size / g, float(np.sqrt(toward @ covered @ toward)) / g
    seen = np.abs(up) >= LEAST_PART
    shares = {}
    by_output = np.asarray(np.linalg.inv(sensitivity) * (sensitivity @ gravity_mps2), dtype=np.float64)
    for i in np.flatnonzero(seen).tolist():
        share, covered, rest = _fit(by_output[:, i : i + 1], change, weight)
        if rest <= chi2_quantile(1.0 - AGREES, 2.0):
            shares[AXES[i]] = float(share[0]), float(np.sqrt(covered[0, 0]))
    unseen = tuple(AXES[i] for i in np.flatnonzero(~seen).tolist())
    return MeanChange(change, u, significant, tilt, shares, unseen)


def _fit(basis: Array, change: Array, weight: Array) -> tuple[Array, Array, float]:
    """Weighted least squares of the change on a basis (3, m): values (m,), covariance (m, m), sum of squares left."""
    covariance = np.asarray(np.linalg.inv(basis.T @ weight @ basis), dtype=np.float64)
    values = covariance @ basis.T @ weight @ change
    left = change - basis @ values
    return values, covariance, float(left @ weight @ left)


def _numbers(values: Array) -> str:
    return ", ".join(f"{x:.2g}" for x in values)
