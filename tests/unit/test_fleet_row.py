"""What a row of the fleet page says of U: with the coverage factor of the result, and never of a net change."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.core.events import DriftReport, Result
from agent.monitor.fleet import Fleet
from calib.drift.drift import DriftVerdict
from calib.drift.net_changes import NetChanges, ReferenceView
from tests.unit.results import calibration, status

PLACE = ("site", "gw", "mems")
T_NS = calibration(1).t_utc_ns


def row_of(*results: Result) -> dict[str, Any]:
    fleet = Fleet(lambda: T_NS)
    fleet.set_alive(*PLACE[:2], True)
    for result in results:
        fleet.take(*PLACE, result.what, json.loads(msgspec.json.encode(result)))
    (row,) = fleet.rows()
    return row


def told(verdict: DriftVerdict) -> DriftReport:
    return DriftReport(
        run_id="r", sequence=9, sensor="mems", t_utc_ns=T_NS, parameter=verdict.parameter, verdict=verdict.verdict,
        change=verdict.change, u_change=verdict.u_change, rate=verdict.rate, u_rate=verdict.u_rate, onset_utc_ns=T_NS,
        statistic=verdict.statistic, threshold=verdict.threshold, false_alarms_a_year=0.1, reason=verdict.reason,
    )  # fmt: skip


def net_change() -> DriftVerdict:
    """S_yy rises steadily by more than a walk of 0.01 a root day may."""
    test, walk, zero = NetChanges(0.05), np.full(12, 1e-4), np.zeros(12)
    makers = [{"S": (1.0, 1e-4), "A": (1.0, 1e-4)}] * 12
    for day in range(60):
        value = np.where(np.arange(12) == 4, 0.02 * day, 0.0)
        if found := test.update({"A": ReferenceView(day, value, zero, zero, walk, zero, zero, makers, True)}):
            return found[0]
    raise AssertionError("nothing was told")


def test_u_has_the_coverage_factor_of_the_result() -> None:
    small = msgspec.structs.replace(calibration(1), coverage_factor=3.0)
    row = row_of(status(2), small)
    assert row["u_pct"] == pytest.approx(100.0 * 3.0 * 6.0 / 26123.0)
    step = DriftVerdict("Syy", "stepped", 360.0, 4.0, np.nan, np.nan, 0.0, 20.0, 15.0, "Syy stepped")
    row = row_of(status(2), small, told(step))
    assert row["size_in_u"] == pytest.approx(360.0 / 18.0)
    assert row["verdicts"][0]["u_change"] == 4.0


@pytest.mark.parametrize("k", [0.0, -2.0, np.nan])
def test_a_result_without_a_coverage_factor_tells_no_u(k: float) -> None:
    step = DriftVerdict("Syy", "stepped", 360.0, 4.0, np.nan, np.nan, 0.0, 20.0, 15.0, "Syy stepped")
    row = row_of(status(2), msgspec.structs.replace(calibration(1), coverage_factor=k), told(step))
    assert (row["u_pct"], row["size_in_u"]) == (None, 0.0)


def test_what_is_stated_of_a_net_change_is_no_u_of_it() -> None:
    verdict = net_change()
    earlier = replace(verdict, u_change=0.05, u_rate=0.01)  # as engines to 22 told it
    (shown,) = row_of(status(2), calibration(1), told(earlier))["verdicts"]
    assert shown["change"] == verdict.change
    assert shown["u_change"] is shown["u_rate"] is None
