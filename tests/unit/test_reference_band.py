"""Motion that a slow or differentiated reference cannot tell is no part of what the sensor is compared with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.unit.drawn_recording import CALM, Devices, Recording, in_force, reports

SLOW = Devices(rate_hz=200.0, reference_rate_hz=50.0, band_hz=(0.5, 16.0))
CASES = {
    "acceleration": SLOW,
    "velocity": replace(SLOW, derivatives=1, reference_noise=1e-6, band_hz=(0.5, 12.0)),
}


@pytest.mark.one_case
@pytest.mark.parametrize("quantity", CASES)
def test_motion_above_the_band_of_the_reference_does_not_count(quantity: str, tmp_path: Path) -> None:
    errors = []
    for seed in range(1):
        recording = Recording(seed, CASES[quantity], bench=True)
        results = recording.through_agent(certificate={"quantity": quantity})
        assert {report.reason for report in reports(results) if not report.used} <= {CALM}
        found = in_force(results)
        errors.append(recording.errors_over_u(found.sensitivity, found.covariance, found.determined))
        status, told = recording.through_files(tmp_path)
        assert (status, told["reasons"]) == (0, [])
        errors.append(
            recording.errors_over_u(told["sensitivity"], told["covariance"], told["determined"]["sensitivity"])
        )
    assert np.isfinite(errors).all()
    assert np.abs(errors).max() < 3.5
    assert np.sqrt(np.mean(np.square(errors))) < 1.6
