"""Where the deviations of Q in tests.realdata.test_imu_array_site come from: all eight IMUs in one fit.

`python -m tests.realdata.imu_array_joint`. The board rests in an unknown direction, in which all IMUs feel gravity. The
unknowns are these directions, and S and Q of each IMU, constant in a recording. Where Q hardly drifts (recordings 2
and 3) such a Q has a third of the uncertainty of the norm fit of one IMU. So it tells the errors of both norm fits that
the test compares, and that of the transfer from IMU 1. In recording 1 the scatter tells that Q is not constant.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from calib.adjustment.norm_fit import NormFit, norm_fit
from calib.excitation.windows import rests_anywhere
from calib.model import Array
from tests.realdata.test_imu_array_site import GRAVITY_MPS2, ROTATIONS, deviations, rests

IMUS, UPPER = 8, np.triu_indices(3)
ELEMENTS = 6 + 9 * (IMUS - 1)  # of S: an upper triangle of IMU 1, whose frame is free
CONSTANT = ELEMENTS + 3 * IMUS  # unknowns beside the directions
LIMIT_MPS2 = 2e-3  # of Q, for 95 %


class Joint(NamedTuple):
    """Q (8, 3) in output unit, its standard uncertainty (8, 3) and the scatter of the rests, in m/s2."""

    offset: Array
    u_mps2: Array
    scatter_mps2: float


def joint_fit(means: Array, fits: list[NormFit]) -> Joint:
    """Of the `means` (8, W, 3) of the rests; `fits`: the norm fit of each IMU."""
    size = np.array([np.linalg.norm(fit.calibration.sensitivity, axis=1) for fit in fits])
    own = fits[0].calibration
    first = (means[0] - own.offset) @ np.linalg.inv(own.sensitivity).T
    first /= np.linalg.norm(first, axis=1)[:, None]
    across = np.array([np.linalg.svd(row[None, :])[2][1:] for row in first])

    def left_mps2(x: Array) -> Array:
        s = np.zeros((IMUS, 3, 3))
        s[0][UPPER], s[1:] = x[:6], x[6:ELEMENTS].reshape(-1, 3, 3)
        a = first + np.einsum("wi,wij->wj", x[CONSTANT:].reshape(-1, 2), across)
        a *= GRAVITY_MPS2 / np.linalg.norm(a, axis=1)[:, None]
        told = np.einsum("kij,wj->kwi", s, a) + x[ELEMENTS:CONSTANT].reshape(-1, 1, 3)
        return ((means - told) / size[:, None]).ravel()

    turned = [np.mean(size[k]) * rotation(k + 1).ravel() for k in range(1, IMUS)]
    begin = [own.sensitivity[UPPER], *turned, *(fit.calibration.offset for fit in fits), np.zeros(2 * len(first))]
    found = least_squares(left_mps2, np.concatenate(begin), x_scale="jac")
    variance = 2.0 * found.cost / (means.size - len(found.x))
    u = np.sqrt(variance * np.diag(np.linalg.inv(found.jac.T @ found.jac))[ELEMENTS:CONSTANT]).reshape(IMUS, 3)
    return Joint(found.x[ELEMENTS:CONSTANT].reshape(IMUS, 3), u / size, float(np.sqrt(variance)))


def rotation(imu: int) -> Array:
    """(3, 3) from the axes of IMU 1 to those of another one."""
    return np.array(ROTATIONS[imu % 2].split(","), float).reshape(3, 3)


def main() -> None:
    """The figures of docs/site.md."""
    others = tuple(range(2, IMUS + 1))
    for recording in (1, 2, 3):
        time_s, counts = rests(recording)
        windows = [[w for w in rests_anywhere(time_s, c, GRAVITY_MPS2) if w.used] for c in counts]
        fits = [norm_fit(each, GRAVITY_MPS2) for each in windows]
        inside = [(time_s >= w.start_s) & (time_s <= w.stop_s) for w in windows[0]]
        joint = joint_fit(np.array([[c[rest].mean(axis=0) for rest in inside] for c in counts]), fits)
        size = np.array([np.linalg.norm(fit.calibration.sensitivity, axis=1) for fit in fits])
        error = (np.array([fit.calibration.offset for fit in fits]) - joint.offset) / size
        with tempfile.TemporaryDirectory() as directory:
            deviation = deviations(recording, others, Path(directory))[1]
        handed_on = np.array([rotation(k) @ error[0] for k in others])
        print(f"recording {recording}: scatter {1e3 * joint.scatter_mps2:.1f} mm/s2, u(Q) by the fit of all at most "
              f"{1e3 * joint.u_mps2.max():.1f} mm/s2")  # fmt: skip
        print(f"  error of Q by IMU 1's norm fit: {np.round(1e3 * error[0], 1)} mm/s2")
        _tell("site adjustment against own norm fits", deviation)
        _tell("the same if the transfer from IMU 1 had no error", handed_on - error[1:])
        _tell("own norm fits against the fit of all", error[1:])
        _tell("error of the transfer alone, by the fit of all", deviation + error[1:] - handed_on)


def _tell(name: str, of: Array) -> None:
    rms, most, within = np.sqrt(np.mean(of**2)), np.abs(of).max(), np.mean(np.abs(of) <= LIMIT_MPS2)
    print(f"  {name}: rms {1e3 * rms:.2f} mm/s2, {within:.0%} within 2 mm/s2, at most {1e3 * most:.1f} mm/s2")


if __name__ == "__main__":
    main()
