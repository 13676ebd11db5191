"""Eight IMUs on one board, recorded three times: norm fits repeat, and one IMU calibrates the others."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest

from calib.adjustment.norm_fit import PARAMETER, NormFit, norm_fit
from calib.estimate.nuisances import Priors
from calib.excitation.front_end import Settings
from calib.excitation.windows import rests_anywhere
from calib.geometry import beside
from calib.model import Array
from calib.recorded.adjusting import adjusted
from calib.recorded.poses import PoseInterval
from calib.recorded.table import ReferenceTable, SensorTable
from calib.recorded.tables import Making, Tables
from calib.signal.instrument import Instrument
from tests.realdata.datasets import dataset
from tests.realdata.test_imu_array_live import GRAVITY_MPS2, OTHER_SIDE, RESTS_END_S

RECORDINGS, IMUS = (1, 2, 3), range(1, 9)


@cache
def recorded(recording: int) -> tuple[Array, Array]:
    held = np.load(dataset("imu_array") / f"recording{recording}.npz")
    return held["time_s"] + 1.0, held["acceleration_count"].astype(float)


@cache
def own_fit(recording: int, imu: int) -> NormFit:
    time_s, counts = recorded(recording)
    return norm_fit(rests_anywhere(time_s, counts[:, imu - 1], GRAVITY_MPS2), GRAVITY_MPS2)


def test_norm_fits_of_the_three_recordings_cover_each_other() -> None:
    """216 comparisons of a parameter: 95 % are expected if S and Q stayed as they were."""
    inside = []
    for imu in IMUS:
        for one, other in itertools.combinations([own_fit(recording, imu) for recording in RECORDINGS], 2):
            values, U = zip(*(_values(fit) for fit in (one, other)), strict=True)
            inside.append(np.abs(values[0] - values[1]) < np.hypot(*U))
    assert np.mean(inside) > 0.85
    assert np.mean(inside, axis=0)[:6].mean() > 0.93  # S alone, which the days between the recordings do not change


def _values(fit: NormFit) -> tuple[Array, Array]:
    c = fit.calibration
    return (
        np.append(c.sensitivity.ravel(), c.offset)[PARAMETER],
        fit.coverage_factor * c.standard_uncertainty[PARAMETER],
    )


@pytest.mark.parametrize(("recording", "imu"), [(1, 4), (1, 7), (2, 2), (2, 3), (3, 5), (3, 8)])
def test_one_imu_calibrates_another_at_rest(recording: int, imu: int) -> None:
    time_s, counts = recorded(recording)
    first, own = own_fit(recording, 1).calibration, own_fit(recording, imu).calibration
    resting = time_s < RESTS_END_S
    reference = (counts[:, 0] - first.offset) @ np.linalg.inv(first.sensitivity).T
    pose = beside(np.eye(3) if imu % 2 else OTHER_SIDE, [0.0, 0.0, 0.0])
    files = Tables(
        SensorTable("sensor.csv", time_s[resting], counts[resting, imu - 1], None),
        ReferenceTable("reference.csv", time_s[resting], reference[resting], "acceleration", "ax"),
        [PoseInterval(float(time_s[0]), RESTS_END_S, pose)],
        Instrument(),
        Making(Settings(bands=True)),
    )
    outcome = adjusted(files, Priors(rotation_rad=float(np.deg2rad(2.0))))
    found = outcome.calibration
    assert found is not None, outcome.reasons
    singular = np.linalg.svd(found.sensitivity)[1] / np.linalg.svd(own.sensitivity)[1] - 1.0
    assert np.abs(singular).max() < 1e-3
    assert np.abs(found.offset - own.offset).max() < 0.008 * np.trace(own.sensitivity) / 3.0
    assert outcome.more["reference_frequency_hz"] == 0.0  # the board was never moved on purpose
