"""Two MPU-9150, put down by hand 22 times: norm fit against the published table (Mikov et al., ICINS 2020)."""

from __future__ import annotations

import numpy as np
import pytest

from calib.adjustment.norm_fit import norm_fit
from calib.excitation.rests import find_rests
from calib.geometry import at_rest
from calib.model import Window, WindowSums
from tests.realdata.datasets import dataset

GRAVITY_MPS2 = 9.81  # as the authors took it
RATE_HZ = 100.0
# s_x, s_y, s_z in %, m_yz, m_xy, m_xz in deg, b_x, b_y, b_z in m/s2, of their sensors 1 and 2
PUBLISHED = {
    "imu0": (0.363, 0.315, 0.647, 0.123, 0.02, 0.317, 0.103, 0.097, 0.344),
    "imu1": (0.471, 0.482, 0.932, -0.284, -0.01, 0.145, 0.09, 0.07, 0.338),
}
# The limits: percentage points of S, and 0.2 mg of Q. The table is rounded to 0.001 % and 0.001 m/s2.
LIMIT_S = 2e-4
LIMIT_Q_MPS2 = 0.2e-3 * GRAVITY_MPS2


def _window(first: float, stop: float, mean: np.ndarray, count: float) -> Window:
    sums = WindowSums(0, np.array([count]), mean[None], np.zeros((1, 3, 3)))
    pose = at_rest([0.0, 0.0, GRAVITY_MPS2], position=f"{first:g}")
    return Window(first, stop, pose, sums, True, "", int(count), 0)


def _expected(sensor: str) -> tuple[np.ndarray, np.ndarray]:
    sx, sy, sz, yz, xy, xz, *offset = PUBLISHED[sensor]
    yz, xy, xz = np.deg2rad([yz, xy, xz])
    S = np.array([[1 + sx / 100, xy, xz], [0.0, 1 + sy / 100, yz], [0.0, 0.0, 1 + sz / 100]])
    return S, np.array(offset)


@pytest.mark.parametrize("sensor", PUBLISHED)
@pytest.mark.parametrize("source", ["static means", "raw log"])
def test_norm_fit_gives_the_published_table(sensor: str, source: str) -> None:
    folder = dataset("mikoff_mpu9150")
    if source == "static means":
        rows = np.loadtxt(folder / f"{sensor}_static_means.csv", delimiter=",")
        windows = [_window(r[0] / RATE_HZ, r[1] / RATE_HZ, r[2:5], r[1] - r[0]) for r in rows]
    else:
        V = np.loadtxt(folder / f"{sensor}.log")[:, :3]
        windows = [
            _window(a / RATE_HZ, b / RATE_HZ, V[a:b].mean(axis=0), float(b - a)) for a, b in find_rests(V, RATE_HZ)
        ]
    assert len(windows) >= 20  # 22 rests are in each log; one may be parted in two, a short one missed
    found = norm_fit(windows, GRAVITY_MPS2)
    S, Q = _expected(sensor)
    assert found.reasons == ()
    np.testing.assert_allclose(found.calibration.sensitivity, S, rtol=0, atol=LIMIT_S)
    np.testing.assert_allclose(found.calibration.offset, Q, rtol=0, atol=LIMIT_Q_MPS2)
    # What it says of itself is of the size of what it is off by: 0.02 % at k = 2, and 2 mm/s2 beside the drift of Q.
    u = found.calibration.standard_uncertainty
    assert 1e-5 < u[0] < 3e-4
    assert 1e-4 < u[9] < 5e-3
