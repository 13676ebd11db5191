"""References that tell a displacement: a laser of 1 um and GNSS of 1 mm, at 10 to 50 Hz beside a faster sensor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.unit.drawn_recording import Devices, Recording, in_force, reports

DISPLACEMENT: dict[str, Any] = {"certificate": {"quantity": "displacement"}}
LASER = Devices(rate_hz=200.0, reference_rate_hz=50.0, derivatives=2, reference_noise=1e-6)
GNSS = Devices(reference_rate_hz=10.0, derivatives=2, reference_noise=1e-3, band_hz=(0.3, 0.9), level_mps2=0.5)
CASES = {
    "laser, 50 Hz": LASER,
    "laser, 25 Hz, motion to 3 Hz": replace(LASER, reference_rate_hz=25.0, band_hz=(0.5, 3.0)),
    "GNSS, 10 Hz, a sine": replace(GNSS, lines=1),  # several lines would fade, and be cut into pieces too short to use
}


@pytest.mark.two_cases
@pytest.mark.parametrize("case", CASES)
def test_s_is_right_within_its_uncertainty(case: str, tmp_path: Path) -> None:
    errors = []
    for seed in range(1):
        recording = Recording(seed, CASES[case], bench=True, stand_s=60.0)
        found = in_force(recording.through_agent(**DISPLACEMENT))
        errors.append(recording.errors_over_u(found.sensitivity, found.covariance, found.determined))
        status, told = recording.through_files(tmp_path, "--reference-quantity", "displacement")
        assert (status, told["reasons"]) == (0, [])
        errors.append(
            recording.errors_over_u(told["sensitivity"], told["covariance"], told["determined"]["sensitivity"])
        )
    assert np.isfinite(errors).mean() > 0.8
    assert np.sqrt(np.nanmean(np.square(errors))) < 1.6
    assert np.nanmax(np.abs(errors)) < 3.5


@pytest.mark.thorough
def test_motion_that_the_noise_hides_is_refused_with_the_reason(tmp_path: Path) -> None:
    small = replace(GNSS, band_hz=(0.5, 4.0), level_mps2=0.01)
    recording = Recording(0, small, bench=True, stand_s=60.0)
    seen = reports(recording.through_agent(**DISPLACEMENT))
    assert seen
    assert not any(report.used for report in seen)
    assert any("the sensor does not follow the reference: coherence" in report.reason for report in seen)
    status, told = recording.through_files(tmp_path)
    assert status == 3
    assert "windows can be used" in told["reasons"][0]
