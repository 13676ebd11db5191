"""A shaker at 10 g, 100 Hz: an AC-coupled reference beside an ADXL345, two clocks. One column of S, and no Q."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from calib.adjustment.adjustment import Adjustment, adjust
from calib.estimate.nuisances import Applied, Priors
from calib.geometry import along
from calib.model import Window
from calib.signal.resampling import resample
from calib.signal.stamps import clock_from_stamps
from calib.windows.sums import window_sums
from tests.realdata.datasets import dataset

ALONG_X = along([1.0, 0.0, 0.0])
PLATEAU_S = (5.2, 9.8)  # the sine at its full 10.13 g
CYCLE_S = 0.01
# Known of the part beforehand: the data sheet's sensitivity within 20 %, cross-axis 3 %; units are g throughout.
PRIOR = replace(
    Priors(),
    parameters=np.concatenate([np.eye(3).ravel(), np.zeros(3)]),
    covariance=np.diag([*np.where(np.eye(3).ravel() > 0, 0.2, 0.03) ** 2, np.inf, np.inf, np.inf]),
)


def _adjusted() -> tuple[Adjustment, np.ndarray]:
    data = np.load(dataset("endaq_shaker") / "SSX66115.npz")
    stamps, V = data["t_dut"], data["dut_raw_g"].astype(float)
    taken = (stamps > PLATEAU_S[0]) & (stamps < PLATEAU_S[1])
    times = clock_from_stamps(stamps).time_of(np.flatnonzero(taken))
    clock = clock_from_stamps(data["t_ref"])
    lag_s = 0.0
    for _ in range(4):  # solve, shift, repeat until the lag is gone
        reference = resample(data["ref_g"].astype(float)[:, :1], clock, times - lag_s)
        # Segments of ten cycles; windows of about half a second.
        per_window = 10 * 10 * CYCLE_S / 2.0
        edges = np.searchsorted(times, np.arange(times[0], times[-1], per_window))
        windows = []
        for a, b in itertools.pairwise(edges):
            cut = np.searchsorted(times[a:b], np.arange(times[a], times[b - 1], 10 * CYCLE_S))
            sums = window_sums(reference.u[a:b], reference.du[a:b], V[taken][a:b], np.append(cut, b - a))
            windows.append(Window(times[a], times[b - 1], ALONG_X, sums, True, "", int(b - a), 0))
        found = adjust(windows, PRIOR, Applied(lag_s=lag_s))
        lag_s = next(n.value for n in found.nuisances if n.name == "lag")
    return found, 1.0 / data["factory_gain"]


def test_one_column_and_no_offset() -> None:
    found, factory = _adjusted()
    S = found.calibration.sensitivity
    assert found.reasons == ()
    # The column along the motion; Q untouched: the mean of x had risen by 16 mg under the vibration.
    assert found.calibration.determined.tolist() == [True, False, False] * 3 + [False] * 3
    assert np.isnan(found.calibration.offset).all()
    assert abs(S[0, 0] / factory[0] - 0.994) < 1e-3
    assert np.nanmax(np.abs(S[1:, 0])) < 0.02
