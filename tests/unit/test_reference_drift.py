"""A reference that drifts after its certificate: its u at the first window, and what years of windows tell."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from agent.config import parse_config, recorded_config
from agent.config.knowledge import Certificate
from calib.estimate.nuisances import Priors
from calib.estimate.wander import TemperatureModel, Wander
from calib.state.state import State
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.unit.mounted_site import EPOCH_NS, begun, site_config, updates

YEAR_DAYS = 365.25
STABILITY, CONSTANT, WALK = 0.005, 0.001, 0.002  # relative: of the reference a year, its certificate; of S, a year
MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.where(np.eye(3).ravel() > 0, 0.05, 0.03), np.full(3, 20.0))
# Windows of the building tell S_yy to 0.02 %, so that the reference decides.
EXACT: dict[str, Any] = {"level_mps2": (0.0, 0.5, 0.0), "noise_mps2": 0.001}
SYY = 4


def drifting(stability: float = STABILITY, walk: float = WALK) -> State:
    priors = Priors(reference=CONSTANT, reference_drift=stability, offset_mps2=1e-3, rotation_rad=0.0)
    wander = Wander(
        {
            **Wander.none().values,
            "offset_rate_mps2": 1e-9,
            "reference_drift": stability / np.sqrt(YEAR_DAYS),
            "sensitivity": walk / np.sqrt(YEAR_DAYS),
        }
    )
    return State(MEAN, U, priors, wander, TemperatureModel(), fixed=True)


def by_hand(days: list[float], stability: float, walk: float) -> float:
    """u of S from exact windows: y = S - constant - drift, three unknowns, dense and without a square root."""
    u = np.array([0.05, CONSTANT, stability * np.sqrt(days[0] / YEAR_DAYS)])
    P, H = np.diag(u**2), np.array([[1.0, -1.0, -1.0]])
    for k, day in enumerate(days):
        P += np.diag([walk**2, 0.0, stability**2]) * (day - days[max(k - 1, 0)]) / YEAR_DAYS
        K = P @ H.T / (H @ P @ H.T + 2e-4**2)
        P = (np.eye(3) - K @ H) @ P
    return float(np.sqrt(P[0, 0]))


@pytest.mark.parametrize("since_days", [0.0, 91.3, 4 * YEAR_DAYS])
def test_what_a_first_window_tells_of_s_is_as_uncertain_as_the_time_since_the_certificate(since_days: float) -> None:
    found = drifting()
    found.date_certificate(10.0 - since_days)
    found.update(Record.of(building_window(np.random.default_rng(1), **EXACT), 10.0))
    expected = np.hypot(CONSTANT, STABILITY * np.sqrt(since_days / YEAR_DAYS))
    assert found.result().standard_uncertainty[SYY] == pytest.approx(expected, rel=0.06, abs=1e-4)


@pytest.mark.one_case
@pytest.mark.parametrize(("stability", "walk"), [(STABILITY, WALK), (STABILITY, 0.0), (0.0, WALK)])
def test_years_of_windows_divide_a_change_between_sensor_and_reference_as_both_are_stated(
    stability: float, walk: float
) -> None:
    random, days = np.random.default_rng(2), [YEAR_DAYS + 73.0 * k for k in range(16)]
    found = drifting(stability, walk)
    found.date_certificate(0.0)
    for day in days:
        found.update(Record.of(building_window(random, **EXACT), day))
    assert found.result().standard_uncertainty[SYY] == pytest.approx(by_hand(days, stability, walk), rel=0.06)


def test_without_a_window_u_grows_by_the_walk_of_the_sensor() -> None:
    found = drifting()
    found.date_certificate(0.0)
    found.update(Record.of(building_window(np.random.default_rng(3), **EXACT), 100.0))
    u, later = (found.law(day).covariance[SYY, SYY] for day in (100.0, 100.0 + YEAR_DAYS))
    assert later - u == pytest.approx(WALK**2, rel=5e-3)  # the walk is bounded by the prior


def test_another_reference_drifts_from_its_own_certificate_on() -> None:
    found, random = drifting(), np.random.default_rng(4)
    found.meet("A")
    found.date_certificate(0.0)
    found.update(Record.of(building_window(random, **EXACT), 10.0, reference="A"))
    found.meet("B")
    found.date_certificate(-1000.0)
    silent = building_window(random, level_mps2=(0.0, 0.0, 0.0))
    found.update(Record.of(silent, 10.0 + YEAR_DAYS, reference="B"))
    years = (10.0 + YEAR_DAYS + 1000.0) / YEAR_DAYS
    assert found.quantity("reference_drift_y")[1] == pytest.approx(STABILITY * np.sqrt(years), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("calibrated", "years"), [("", 0.0), ("2022-09-22", 4.0), ("2090-01-01", 0.0)])
def test_the_agent_counts_from_the_date_in_the_configuration_to_the_utc_of_the_first_window(
    calibrated: str, years: float
) -> None:
    assert datetime.fromtimestamp(EPOCH_NS * 1e-9, UTC).date().isoformat() == "2026-09-21"
    constant, drifts = (
        begun(site_config(certificate={"calibrated": calibrated, "stability_pct": stability_pct}))
        for stability_pct in (0.0, 0.5)
    )
    for site in (constant, drifts):
        site.play(2)
    u0, u = (np.array(updates(site.results)[0].standard_uncertainty)[[0, 4, 8]] for site in (constant, drifts))
    np.testing.assert_allclose(np.sqrt(np.maximum(u**2 - u0**2, 0.0)), 0.005 * np.sqrt(years), rtol=0.05, atol=2e-5)


def test_a_snapshot_keeps_the_date() -> None:
    found = drifting()
    found.date_certificate(3.0)
    again = drifting()
    again.load(found.snapshot())
    one = Record.of(building_window(np.random.default_rng(5), **EXACT), 500.0)
    found.update(one)
    again.update(one)
    assert np.array_equal(again.result().covariance, found.result().covariance)


def test_a_certificate_is_overdue_after_its_interval_and_not_before() -> None:
    certificate = Certificate(calibrated="2024-03-01", interval_years=2)
    assert certificate.overdue(datetime(2026, 2, 28, tzinfo=UTC)) == ""
    said = certificate.overdue(datetime(2026, 9, 1, tzinfo=UTC))
    assert "calibrated: 2024-03-01 is 2.5 years ago, more than interval_years 2; " in said
    assert "in the future" in certificate.overdue(datetime(2024, 2, 1, tzinfo=UTC))
    assert Certificate(calibrated="1999-03-01").overdue(datetime(2026, 9, 1, tzinfo=UTC)) == ""


def test_a_recording_of_the_version_before_keeps_its_drift_of_the_reference() -> None:
    text = site_config().model_dump_json()
    before = text.replace('"calibrated":"","interval', '"calibrated":"in May","interval').replace(
        '"process":{', '"process":{"reference_pct":0.01,'
    )
    assert before.count("reference_pct") == before.count("in May") == 1
    certificate = recorded_config(before).channels[0].certificate
    assert certificate.stability_pct == pytest.approx(0.01 * np.sqrt(YEAR_DAYS))
    assert certificate.calibrated == ""
    assert recorded_config(text) == parse_config(site_config().model_dump(mode="json"), "")
