"""A reference whose certificate says by how much its indications come late: windows that come so late are sound."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.mounted_site import begun, said, site_config, updates, windows

LATE_S = 0.005
S_AND_LAG = {"uncertainty": {"lag_s": 1e-4}, "certificate": {"lag_s": LATE_S, "u_lag_s": 1e-4}}


@pytest.mark.slow
def test_a_reference_that_is_late_as_certified_calibrates() -> None:
    site = begun(site_config(**S_AND_LAG))
    site.late_s["r"] = LATE_S
    found = site.play(8)
    reports = windows(found)
    assert len(reports) >= 6
    assert [report.reason for report in reports if not report.used] == []
    assert said(found)[-1][0] == "VALID"
    # The sensor's indications come before those of the reference.
    assert [report.numbers["lag_applied_s"] for report in reports] == pytest.approx([-LATE_S] * len(reports), abs=2e-4)
    in_force = updates(found)[-1]
    estimation = site.pipeline._channels[0]._estimation
    assert estimation is not None
    lag_s, u_lag_s = estimation.state.quantity("lag")
    assert abs(lag_s + LATE_S) < 3.0 * u_lag_s <= 3.0 * np.hypot(1e-4, 1e-4)
    assert in_force.windows >= 6


@pytest.mark.thorough
def test_a_reference_that_is_not_late_contradicts_its_certificate() -> None:
    found = begun(site_config(**S_AND_LAG)).play(8)
    assert said(found)[-1][0] == "HELD"


def test_what_is_uncertain_of_the_lag_is_that_of_the_certificate_and_of_the_sensor() -> None:
    channel = site_config(uncertainty={"lag_s": 3e-4}, certificate={"lag_s": -0.002, "u_lag_s": 4e-4}).channels[0]
    priors = channel.priors(fixed_mount=True)
    assert (priors.lag_at_s, priors.lag_s) == pytest.approx((0.002, 5e-4))
