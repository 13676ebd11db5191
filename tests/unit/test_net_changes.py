"""Net changes that the stated walks do not allow: when they are told, who made them, and that U covers them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from agent.core.snapshot import pack, unpack
from benchmarks.walks import STABILITY_PCT, WALK_PCT, Drawn, Life, channel, drawn, lived, none
from calib.drift.drift import DriftVerdict
from calib.drift.net_changes import NetChanges, ReferenceView
from calib.estimate.nuisances import Priors
from calib.estimate.statements import Widening
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Array
from calib.state.state import State
from calib.windows.record import Record
from tests.building_windows import building_window

SYY, SXY = 4, 1
ZERO, ONES = np.zeros(12), np.ones(12)
WALK = 0.01  # a root day, of all parameters
RATE = 0.05  # false alarms a year
# 12 parameters, one look a day: one false alarm in 20 years is one in 87,660 looks of a parameter. The formula of
# Siegmund and Venkatraman (1995), Theorem 1, for spans of 7 to 1461 days, then has b^2 / 2 = 11.2.
THRESHOLD = 11.2


def seen(day: float, value: Array, *makers: str) -> ReferenceView:
    by_parameter = [dict.fromkeys((f"S{p}", *makers), (1.0, WALK**2)) for p in range(12)]
    return ReferenceView(day, value, ZERO, ZERO, WALK**2 * ONES, ZERO, ZERO, by_parameter, True)


def told(net: NetChanges, courses: Mapping[str, Array], first: int = 0) -> list[tuple[int, DriftVerdict]]:
    """What is told of values (D, 12), one a day, beside each reference."""
    days = len(next(iter(courses.values())))
    return [
        (day, verdict)
        for day in range(first, days)
        for verdict in net.update({name: seen(day, values[day], name) for name, values in courses.items()})
    ]


def ramp(days: int, a_day: float) -> Array:
    values = np.zeros((days, 12))
    values[:, SYY] = a_day * np.arange(days)
    return values


@pytest.mark.parametrize("sds_a_day", [0.5, 1.0, 1.7])
def test_a_drift_is_told_when_its_net_change_is_beyond_what_the_walk_allows(sds_a_day: float) -> None:
    net = NetChanges(RATE)
    assert net.threshold(1) == pytest.approx(THRESHOLD, abs=0.05)
    day, verdict = told(net, {"A": ramp(120, sds_a_day * WALK)})[0]
    assert day == max(7, np.ceil(2.0 * THRESHOLD / sds_a_day**2))  # rate t over walk sqrt(t)
    assert (verdict.parameter, verdict.verdict) == ("Syy", "drifting")
    assert verdict.change == pytest.approx(sds_a_day * WALK * day, rel=1e-9)
    assert f"what is stated allows {WALK * np.sqrt(day):.2g} " in verdict.reason
    assert np.isnan([verdict.u_change, verdict.u_rate]).all()
    assert "sensor or reference" in verdict.reason


def test_the_error_of_a_rate_counts_over_the_whole_span() -> None:
    """The covariance with the rate is half of the walk's variance a day: 2 L of it is as much as the walk over L."""
    net = NetChanges(RATE)
    course = [
        replace(seen(day, value, "A"), with_rate=0.5 * WALK**2 * ONES) for day, value in enumerate(ramp(60, WALK))
    ]
    day, verdict = next((shown.day, found) for shown in course for found in net.update({"A": shown}))
    assert day == np.ceil(4.0 * THRESHOLD)
    assert f"what is stated allows {WALK * np.sqrt(2.0 * day):.2g} " in verdict.reason


@pytest.mark.parametrize(("begins", "cause"), [(5, "sensor, because B"), (7, "sensor or reference")])
def test_another_reference_tells_who_has_drifted_if_it_was_there_for_three_quarters_of_the_time(
    begins: int, cause: str
) -> None:
    net, values = NetChanges(RATE), ramp(40, WALK)
    for day, value in enumerate(values):
        there = ("A", "B") if day >= begins else ("A",)
        if found := net.update({name: seen(day, value, name) for name in there}):
            assert 20 < day < 26  # a quarter of it is between 5 and 7 days
            assert cause in found[0].reason
            return
    raise AssertionError("nothing was told")


@pytest.mark.thorough
def test_walks_as_they_are_stated_are_told_at_most_as_often_as_the_formula_says() -> None:
    """3 lives of 8 years at 2 false alarms a year: 48 by the formula, an upper bound. The spans that are kept, and
    daily looks, leave at least a third; 99.9 % of Poisson counts of 16 to 48 are 5 to 73."""
    count = 0
    for seed in range(3):
        net = NetChanges(2.0)
        values = WALK * np.cumsum(np.random.default_rng(seed).normal(size=(2922, 12)), axis=0)
        for day, value in enumerate(values):
            count += any(v.verdict == "drifting" for v in net.update({"A": seen(day, value, "A")}))
            if net.drifting:
                net.restart()
    assert 5 <= count <= 73


@pytest.mark.parametrize(
    ("beside_b", "cause"), [(0.0, "reference A, because B does not show it"), (1.0, "sensor, because B shows the same")]
)
def test_another_reference_tells_who_has_drifted(beside_b: float, cause: str) -> None:
    net = NetChanges(RATE)
    found = told(net, {"A": ramp(40, WALK), "B": beside_b * ramp(40, WALK)})
    assert cause in found[0][1].reason
    keys = {key for widening in net.widened for key in widening.u}
    assert keys == ({f"S{SYY}"} if beside_b else {"A"})


def test_as_long_as_nothing_tells_both_may_have_made_half_of_it_and_it_is_told_again_when_it_has_doubled() -> None:
    net = NetChanges(RATE)
    days = [day for day, _ in told(net, {"A": ramp(100, WALK)})]
    assert days == [23, 46, 92]
    (widening,) = net.widened
    share = (99 * WALK / 1.4) ** 2 / 2.0 - 99 * WALK**2  # U = 2 u covers either; the stated walk is part of it
    assert widening.u == pytest.approx({f"S{SYY}": np.sqrt(share), "A": np.sqrt(share)})


def test_what_was_told_stays_told_until_a_restart_and_u_stays_wide() -> None:
    net = NetChanges(RATE)
    back = np.concatenate([ramp(60, WALK), ramp(60, WALK)[::-1]])
    told(net, {"A": back})
    (widening,) = net.widened
    assert (widening.since, widening.until) == (0.0, 59.0)
    net.restart()
    assert [v.verdict for v in net.update({"A": seen(120.0, ZERO, "A")})] == ["stable"]
    assert net.widened == [widening]
    assert net.drifting == set()


def test_the_sums_survive_a_restart_of_the_program_bit_for_bit() -> None:
    random = np.random.default_rng(7)
    values = ramp(300, 0.5 * WALK) + WALK * np.cumsum(random.normal(size=(300, 12)), axis=0)
    whole, first, second = (NetChanges(RATE) for _ in range(3))
    expected = told(whole, {"A": values})
    found = told(first, {"A": values[:150]})
    second.load(unpack(pack(first.snapshot())))
    found += told(second, {"A": values}, first=150)
    assert pack(second.snapshot()) == pack(whole.snapshot())
    assert repr(found) == repr(expected) != "[]"


def test_a_widened_walk_adds_its_variance_in_proportion_to_the_time() -> None:
    mean = np.append(np.eye(3).ravel(), np.zeros(3))
    u = np.append(np.full(9, 0.05), np.full(3, 1.0))
    priors = Priors(dict(Priors.none().values) | {"offset_mps2": 0.01})
    found = State(mean, u, priors, Wander.none(), TemperatureModel(), fixed=False)
    found.update(Record.of(building_window(np.random.default_rng(1), level_mps2=(0.1, 0.1, 0.1)), 0.0))
    before = found.covariance()[SYY, SYY]
    found.widen([Widening(-5.0, 15.0, {"Syy": 0.02})])
    found.solve()
    for day, share in ((5.0, 0.25), (15.0, 0.75), (40.0, 0.75)):
        assert found.law(day).covariance[SYY, SYY] - before == pytest.approx(share * 0.02**2, rel=1e-6)
    assert found.law(40.0).covariance[SXY, SXY] == pytest.approx(found.covariance()[SXY, SXY], rel=1e-9)


def life_of(rate_pct: float, days: int) -> Life:
    """S_yy drifts beside a perfect reference; all settings default."""
    stated = channel(WALK_PCT, STABILITY_PCT)
    a_day = rate_pct / 100.0 / 365.25
    return lived(stated, np.arange(float(days)), 1, lambda day: np.diag([1.0, 1.0 + a_day * day, 1.0]), none, none, 12)


@pytest.mark.thorough
def test_a_drift_of_ten_per_cent_a_year_is_told_within_a_month_and_u_covers_it() -> None:
    life = life_of(10.0, 40)
    assert life.told_of("Syy") <= 31
    assert np.abs(life.errors / life.u)[:, SYY].max() < 2.0
    assert abs(life.errors[-1, SYY]) > 0.004  # half of the change
    assert {v.parameter for _, v in life.told} == {"Syy"}


@pytest.mark.slow
def test_a_step_of_a_reference_within_the_u_of_its_certificate_makes_u_grow() -> None:
    days = np.append(np.arange(12.0), 12.0 + 0.25 * np.arange(8))
    life = lived(
        channel(WALK_PCT, STABILITY_PCT),
        days,
        1,
        lambda _: np.eye(3),
        lambda day: np.array([0.0, 0.007 * (day >= 12.0), 0.0]),
        none,
    )
    assert abs(life.errors[-1, SYY]) > 0.004  # S follows
    assert life.u[-1, SYY] > 1.3 * life.u[11, SYY]
    assert np.abs(life.errors / life.u)[:, SYY].max() < 2.0


@pytest.mark.slow
def test_an_estimation_goes_on_from_its_snapshot_bit_for_bit() -> None:
    days = np.arange(16.0)
    found, again = (Drawn(channel(WALK_PCT, STABILITY_PCT), None) for _ in range(2))
    found.meet("A", "", 1.0)
    for day in days:
        found.take(drawn(np.random.default_rng(int(day)), day, np.diag([1.0, 1.0 + 0.001 * day, 1.0]), 12))
    assert found.net_changes.drifting == {"Syy"}
    again.load(unpack(pack(found.snapshot())))
    for one in (found, again):
        one.take(drawn(np.random.default_rng(99), 20.0, np.eye(3), 12))
    assert pack(again.snapshot()) == pack(found.snapshot())
