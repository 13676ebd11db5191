"""When to look again: the interval from a history, against closed formulas and against its own promise."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from agent.delivery.keys import Address
from agent.delivery.received import Received
from agent.monitor.advising import Advisor
from agent.monitor.database import Database
from agent.monitor.engines import Sqlite
from agent.monitor.fleet import Fleet
from agent.monitor.interval import DAY_NS, K, Trend, advise, daily, spread_of_rates, trend
from tests.unit.results import calibration


def test_a_known_line_gives_the_known_interval() -> None:
    t = np.array([0.0, 100.0, 200.0, 300.0])
    line = trend(t, 5.0 + 0.02 * t, np.full(4, 0.1))
    assert line is not None
    assert line.rate == pytest.approx(0.02)
    assert line.u_rate == pytest.approx(0.1 / math.sqrt(np.sum((t - 150.0) ** 2)))
    assert line.random == 0.0
    advice = advise(line, 4.0, None, "V")
    assert advice.interval_days == pytest.approx(4.0 / (0.02 + K * line.u_rate))  # |b| T + K u(b) T = limit
    assert "drift 7.3 ± " in advice.reason
    assert "limit 4 V" in advice.reason


@pytest.mark.parametrize("number", [1e308, -1e308, 1e200, 1e154, 5e-324, 1e-200, 0.0])
def test_numbers_beyond_any_instrument_fail_nothing(number: float) -> None:
    """A stranger's sensor of the same kind is a peer of the others, whose advice must not fail with it."""
    t, values, u = np.arange(5.0), np.arange(5.0) ** 2, np.full(5, 0.1)
    sound = Trend(0.01, 0.002, 0.1, 10, 1000.0)
    for hostile in (np.array([number, *values[1:]]), np.full(5, number)):
        for hostile_u in (u, np.array([abs(number), *u[1:]]), np.full(5, abs(number))):
            for line in (trend(t, hostile, u), trend(t, values, hostile_u), trend(t, hostile, hostile_u)):
                spread = spread_of_rates([line] * 3) if line is not None else None
                for own, limit in ((sound, 2.0), (line, 2.0), (line, 2.0 * abs(number)), (sound, math.inf)):
                    interval = advise(own, limit, spread, "V").interval_days
                    assert interval is None or 0.0 <= interval <= 2000.0


def test_random_changes_are_in_the_interval() -> None:
    line = Trend(rate=0.01, u_rate=0.002, random=0.3, points=10, span_days=1000.0)
    interval = advise(line, 2.0, None, "V").interval_days
    assert interval is not None
    assert 0.01 * interval + K * math.hypot(0.002 * interval, 0.3) == pytest.approx(2.0)
    assert advise(Trend(0.0, 0.1, 2.0, 9, 9.0), 2.0, None, "V"
                  ).interval_days == 0.0  # fmt: skip


def test_a_short_history_promises_at_most_twice_its_length() -> None:
    advice = advise(Trend(0.0, 1e-6, 0.0, 5, 30.0), 1.0, None, "V")
    assert (advice.interval_days, "bounds it" in advice.reason) == (60.0, True)
    assert advise(None, 1.0, None, "V").interval_days is None
    assert trend(np.array([0.0, 1.0, 2.0]), np.zeros(3), np.ones(3)) is None
    assert trend(np.zeros(5), np.zeros(5), np.ones(5)) is None


def test_peers_narrow_a_short_history_but_do_not_hide_a_drift() -> None:
    calm = [Trend(0.0, 1e-4, 0.0, 20, 700.0)] * 8
    spread = spread_of_rates(calm)
    assert spread is not None
    assert spread < 1e-4
    assert spread_of_rates(calm[:2]) is None
    young = Trend(2e-3, 5e-3, 0.0, 4, 200.0)
    alone, together = advise(young, 1.0, None, "V").interval_days, advise(young, 1.0, spread, "V").interval_days
    assert alone is not None
    assert together is not None
    assert alone < 100.0 < together
    drifting = Trend(0.1, 5e-3, 0.0, 20, 200.0)
    assert advise(drifting, 1.0, spread, "V").interval_days == advise(drifting, 1.0, None, "V").interval_days
    assert "which it contradicts" in advise(drifting, 1.0, spread, "V").reason


def test_the_spread_of_the_peers_is_found() -> None:
    random = np.random.default_rng(4)
    u = 0.1
    found = []
    for _ in range(200):
        rates = random.normal(0.0, 1.0, size=10) + random.normal(0.0, u, size=10)
        found.append(spread_of_rates([Trend(float(b), u, 0.0, 5, 100.0) for b in rates]))
    assert 1.0 < float(np.mean(np.square(np.array(found, dtype=float)))) < 1.1  # upper limit, so above 1


def test_the_change_exceeds_the_limit_in_at_most_5_percent() -> None:
    """The promise: 2,000 instruments with drifts; at the end of the interval at most 5 % are beyond the limit."""
    random = np.random.default_rng(9)
    t, u, limit, beyond, told = np.linspace(0.0, 400.0, 9), 0.2, 1.0, 0, 0
    for rate in random.normal(0.0, 2e-3, size=2000):
        line = trend(t, rate * t + random.normal(0.0, u, size=9), np.full(9, u))
        assert line is not None
        interval = advise(line, limit, None, "V").interval_days
        assert interval is not None
        told += 1
        beyond += abs(rate) * interval > limit
    assert beyond / told <= 0.05 + 2.6 * math.sqrt(0.05 * 0.95 / told)  # 99.5 % of the binomial
    assert beyond > 0  # the interval is not so short that nothing ever happens


def test_calibrations_of_one_day_count_once() -> None:
    assert daily([0, 5, DAY_NS - 1, DAY_NS, 3 * DAY_NS, 3 * DAY_NS + 1]) == [2, 3, 5]


def test_the_advice_of_a_sensor_names_the_parameter_that_changes_most(tmp_path: Path) -> None:
    database, fleet = Database(Sqlite(tmp_path / "monitor.sqlite")), Fleet()
    advisor = Advisor(database, fleet)
    place = ("site", "gw", "mems")
    shared = {"reference": "R 1", "serial_number": "1", "sensitivity": [100.0], "kinds": ["reference sensitivity"],
              "u_stated": [1e-3]}  # fmt: skip
    for k in range(10):
        made = calibration(k + 1, sxx=26154.0 + 2.0 * k)  # 2 in 30 days, against U = 12
        fields = msgspec.json.decode(msgspec.json.encode(made))
        fields |= {"t_utc_ns": 30 * k * DAY_NS, "shared_errors": [shared | {"certificate_sha256": f"{k // 5}"}]}
        database.add([Received("", Address(*place, "calibration"), k + 1, fields, None)])
        fleet.take(*place, "calibration", fields)
    sensor, reference = advisor.advice(place)
    assert sensor["subject"] == "mems"
    assert sensor["reason"].startswith("Sxx: 10 calibrations in 270 days, drift 24.4 ")
    assert 100 < sensor["interval_days"] < 180  # 12 at 2 in 30 days is 180 days, less what is not sure
    assert sensor["due_utc_ns"] == 270 * DAY_NS + round(sensor["interval_days"] * DAY_NS)
    assert (reference["subject"], reference["interval_days"]) == ("reference R 1", None)
    assert "2 certificates in the history" in reference["reason"]
    assert advisor.advice(("site", "gw", "other")) == []
    numbers = [made["sequence"] for made in database.spread(*place, "calibration", 4)]
    assert (len(numbers), numbers[-1], numbers == sorted(numbers)) == (4, 10, True)
    assert [made["sequence"] for made in database.spread(*place, "calibration", 100)] == list(range(1, 11))
    database.close()
