"""The clamp of a portable reference: fine, turned, loose, or where hardly anything moves; and how long to stay."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from agent.bench.clamp_words import findings
from agent.bench.growth import MONTH_DAYS, growth
from agent.bench.visit_dialogue import forbidden
from agent.bench.visiting import ahead
from benchmarks.visits import Visit
from calib.model import PARAMETERS, Calibration
from calib.recorded.outcome import Outcome
from calib.visit.clamping import Clamping, clamping
from calib.visit.next_stop import WantedUncertainty
from hw.virtual.visits import Clamped

SECONDS = 30.0


def _seen(way: Clamped, seed: int = 3, seconds: float = SECONDS) -> tuple[Visit, Clamping]:
    visit = Visit.drawn(seed, way)
    known = visit.measuring.priors
    windows = visit.measuring.without_lag(visit.record(seconds), [visit.taken(seconds)])
    assert known.parameters is not None
    assert known.covariance is not None
    found = clamping(windows, known.parameters, known.covariance, known.rotation_rad)
    assert found is not None
    return visit, found


@pytest.mark.slow
def test_a_good_clamp_has_no_findings():
    for seed in range(3):
        _, found = _seen(Clamped(), seed)
        assert findings(found, "sensor") == {}
        assert found.coherence > 0.99


@pytest.mark.one_case
@pytest.mark.parametrize(
    "by_deg", [(0.0, 0.0, 5.0), (-7.0, 0.0, 0.0), (3.0, -4.0, 3.0), (0.0, 0.0, 90.0), (180.0, 0, 0)]
)
def test_a_turned_reference_is_told_with_its_angle(by_deg):
    _, found = _seen(Clamped(turned_deg=np.array(by_deg)))
    off_deg = np.abs(np.abs(found.turned_deg) - np.abs(by_deg))  # 180 deg about x is also -180 deg
    assert off_deg.max() < 4.0 * float(np.hypot(found.u_turned_deg.max(), 0.2))
    told = findings(found, "sensor")
    assert set(told) == {"turned"}
    assert "turned by" in told["turned"]
    assert np.sign(found.turned_deg[2]) == np.sign(by_deg[2]) or by_deg[2] == 0.0


@pytest.mark.slow
def test_a_clamp_on_a_spring_is_loose():
    """At 25 Hz of resonance, a mass on a spring shows (f / 25 Hz)^2 too much: 29 % at 13.5 Hz."""
    _, found = _seen(Clamped(loose=True))
    assert found.rise == pytest.approx((found.high_hz / 25.0) ** 2, rel=0.1)
    assert found.rattle == pytest.approx(0.1, rel=0.4)
    assert "loose" in findings(found, "sensor")["loose"]


@pytest.mark.slow
def test_little_motion_is_no_loose_clamp():
    _, found = _seen(Clamped(calm=True), seconds=60.0)
    assert set(findings(found, "sensor")) == {"little motion"}
    assert found.noise_mps2 == pytest.approx(0.005, rel=0.7)


def _outcome(type_a: float, reference: float) -> Outcome:
    found = Calibration(np.eye(3), np.zeros(3), np.eye(12), np.ones(12, dtype=bool), np.inf, "")
    budget = {
        "type A": dict.fromkeys(PARAMETERS, type_a), "reference sensitivity": dict.fromkeys(PARAMETERS, reference)
    }  # fmt: skip
    return Outcome(found, (), [], 200.0, "", more={"budget": budget})


def test_the_time_follows_from_the_budget():
    """The variance of noise falls with the inverse of the time; the reference stays, and forbids what is below it."""
    wanted = WantedUncertainty(2.0 * np.hypot(0.003, 0.004 / 2.0), np.inf)  # a half of the noise: four times the time
    told = ahead(_outcome(0.004, 0.003), 30.0, wanted)
    assert told is not None
    assert told.now == pytest.approx(np.full(9, 0.01))
    assert told.needed_s == pytest.approx(120.0)
    never = ahead(_outcome(0.004, 0.003), 30.0, WantedUncertainty(0.0059, np.inf))
    assert never is not None
    assert np.isinf(never.needed_s)
    assert never.at_last == pytest.approx(np.full(9, 0.006))
    assert never.because == "reference sensitivity"


def test_what_the_reference_forbids_is_said():
    assert forbidden(0.004, 0.003).startswith("0.3 % cannot be reached with this reference: its own U is 0.4 %")
    assert forbidden(0.002, 0.003) == ""


def test_u_grows_as_the_configuration_states():
    """After a year: a walk of 0.018 % a day, and 10 K at 0.02 %/K; the date is where U crosses the limit."""
    channel = Visit.drawn(1, Clamped()).channel
    u_main = 0.001
    u = {"sensitivity": np.full((3, 3), u_main).tolist(), "offset": [u_main] * 3}
    later = growth(channel, {"sensitivity": np.eye(3).tolist(), "standard_uncertainty": u}, 10.0)
    year_days = 12.0 * MONTH_DAYS
    expected = 200.0 * np.sqrt(u_main**2 + (1.8e-4) ** 2 * year_days + (2e-4 * 10.0) ** 2)
    assert later.main_pct(year_days) == pytest.approx(expected, rel=1e-6)
    assert later.main_pct(0.0) == pytest.approx(0.2)
    days = later.days_until(0.5)
    assert days is not None
    assert later.main_pct(days - 1.0) < 0.5 < later.main_pct(days + 1.0)
    assert later.days_until(0.4) == 0.0
    assert later.days_until(50.0) is None
    told = later.as_object(0.5, datetime(2026, 1, 1, tzinfo=UTC))
    assert [a["months"] for a in told["after"]] == [0, 1, 3, 6, 12]
    assert told["exceeded_on"] > "2026-02-01"
