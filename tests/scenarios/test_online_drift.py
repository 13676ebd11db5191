"""A drift of S far faster than stated; docs/online-evidence.md has more runs (`python -m benchmarks.online drift`)."""

from __future__ import annotations

import pytest

from benchmarks.online import drifting
from benchmarks.online.node import Timing

TIMING = Timing(20.0, 12 * 3600.0, 70)  # 35 days, in which S_yy drifts by 1 %


def test_a_drift_of_ten_percent_a_year_is_told_and_covered() -> None:
    run = drifting.one(drifting.SEED + 1, drifting.RATE_PCT, TIMING)
    assert {parameter for parameter, _ in run.found} == {"Syy"}
    assert len(run.errors) >= 65
    assert (run.beyond, run.held) == (0, 0)


@pytest.mark.thorough
def test_without_a_drift_nothing_is_told() -> None:
    run = drifting.one(drifting.SEED, 0.0, TIMING)
    assert (run.found, run.beyond, run.held) == ([], 0, 0)
