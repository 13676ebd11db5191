"""Joined segments of a long recording: the sums are the same, and S, Q and their uncertainties hardly change."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.long_files import SENSITIVITY, minutes_of, pose_rows
from calib.recorded import segments
from calib.recorded.calibrating import calibrated
from calib.recorded.options import Options
from calib.recorded.outcome import Outcome
from calib.recorded.poses import PoseRow, Poses
from calib.recorded.table import ReferenceTable, SensorTable
from calib.windows.sums import pool, window_sums


@pytest.mark.parametrize(("size", "counts"), [(1, [9] * 7), (3, [27, 36]), (7, [63]), (9, [63])])
def test_the_sums_stay(size: int, counts: list[int]) -> None:
    rng = np.random.default_rng(1)
    u, du, V = (rng.normal(size=(63, k)) for k in (1, 1, 3))
    sums = window_sums(u, du, V, np.arange(0, 64, 9))
    joined = segments.with_joined(sums, size)
    assert joined.count.tolist() == counts
    before, after = pool(sums), pool(joined)
    np.testing.assert_allclose(after.mean, before.mean, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(after.scatter, before.scatter, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("length_s", "size"), [(0.0, 1), (4 * 3600.0, 1), (86_400.0, 6), (7 * 86_400.0, 37)])
def test_the_number_of_segments_is_bounded(length_s: float, size: int) -> None:
    assert segments.segments_joined(length_s, 0.5) == size
    assert length_s / 0.5 / size <= segments.MOST_SEGMENTS


def of_ten_minutes() -> Outcome:
    time_s, u, V = (np.concatenate(part) for part in zip(*minutes_of(10, 1), strict=True))
    poses = Poses("poses", [PoseRow(a, b, {"theta_deg": 35.0, "alpha_deg": alpha}) for a, b, alpha in pose_rows(10)])
    reference = ReferenceTable("reference", time_s, u, "acceleration", "a")
    return calibrated(SensorTable("sensor", time_s, V), reference, poses, Options())


@pytest.mark.thorough
def test_a_calibration_hardly_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    """1180 segments, and a sixth of them, as of a day."""
    as_they_are = of_ten_minutes()
    monkeypatch.setattr(segments, "MOST_SEGMENTS", 200)
    joined = of_ten_minutes()
    assert max(len(w.sums.count) for w in as_they_are.windows) > 6 * max(len(w.sums.count) for w in joined.windows) - 6
    assert as_they_are.calibration is not None
    assert joined.calibration is not None
    u = as_they_are.calibration.standard_uncertainty
    moved = np.abs(joined.calibration.sensitivity - as_they_are.calibration.sensitivity).ravel()
    assert (moved < 0.02 * u[:9]).all()
    np.testing.assert_allclose(joined.calibration.standard_uncertainty, u, rtol=0.05)
    assert (np.abs(joined.calibration.sensitivity - SENSITIVITY).ravel() < 3.0 * u[:9]).all()
