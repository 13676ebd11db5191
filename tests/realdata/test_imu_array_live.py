"""Eight IMUs turned together by hand through 20 rests, then shaken violently: IMU 1 is the reference of the others.

Truth is each IMU's own norm fit of the same recording. A rotation of the frame is free there, so the lengths of S's
rows and its singular values are compared: for these IMUs a row's length is its main sensitivity to 0.02 %.
"""

from __future__ import annotations

import numpy as np
import pytest

from calib.adjustment.norm_fit import norm_fit
from calib.excitation.windows import rests_anywhere
from calib.model import Calibration
from tests.imu_pair import Array, calibrated
from tests.realdata.datasets import dataset

GRAVITY_MPS2 = 9.81898  # Stockholm
NOMINAL, RATE_HZ = 209.0, 62.5  # counts per m/s2, Hz
OTHER_SIDE = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
RESTS_END_S = 490.0
LIMIT = 0.002


def own_fit(time_s: Array, counts: Array) -> Calibration:
    return norm_fit(rests_anywhere(time_s, counts, GRAVITY_MPS2), GRAVITY_MPS2).calibration


@pytest.mark.parametrize(
    ("recording", "imu"), [(1, 2), (1, 3), (1, 4), (1, 5), (1, 6), (1, 7), (1, 8), (2, 2), (2, 5), (3, 4), (3, 7)]
)
def test_rests_beside_another_imu_calibrate_and_violence_changes_nothing(recording: int, imu: int) -> None:
    held = np.load(dataset("imu_array") / f"recording{recording}.npz")
    time_s, counts = held["time_s"] + 1.0, held["acceleration_count"].astype(float)
    first, own = own_fit(time_s, counts[:, 0]), own_fit(time_s, counts[:, imu - 1])
    reference = (counts[:, 0] - first.offset) @ np.linalg.inv(first.sensitivity).T
    rotation = np.eye(3) if imu % 2 else OTHER_SIDE
    session = calibrated(time_s, counts[:, imu - 1], reference, rotation, NOMINAL, RATE_HZ)
    rows, singular = np.linalg.norm(own.sensitivity, axis=1), np.linalg.svd(own.sensitivity)[1]
    late = [update for at_s, update in session.calibrations if at_s >= RESTS_END_S]
    assert late
    for update in late:
        S, u = np.array(update.sensitivity), np.array(update.standard_uncertainty)[[0, 4, 8]] / NOMINAL
        off = np.linalg.norm(S, axis=1) / rows - 1.0
        assert np.abs(off).max() < LIMIT
        assert (np.abs(off) < 2.0 * u).all()
        assert np.abs(np.linalg.svd(S)[1] / singular - 1.0).max() < LIMIT
    assert sum(window.used for window in session.windows) >= 20
