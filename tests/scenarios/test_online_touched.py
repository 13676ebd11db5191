"""A gateway that is touched: what an exact batch says, and short lives against it.

docs/online-evidence.md has 100 lives of each kind (`python -m benchmarks.online touched`).
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.online import touched
from benchmarks.online.life import House
from benchmarks.online.touched import SEED, drawn, exact_batch_pct, most_false_holds, reconfigured, swapped

# u is relative to S, which is off its nominal value by 3 %; this moves the share of the prior in the exact batch.
NEARLY = 0.998


def test_the_exact_batch_and_the_chance_of_false_holds() -> None:
    assert exact_batch_pct(1) == pytest.approx(3.0 * 0.3 / np.hypot(3.0, 0.3), rel=1e-12)
    assert exact_batch_pct(2) == pytest.approx(0.2116, abs=1e-4)
    assert most_false_holds(24_000) == 8


def test_while_nothing_is_touched_u_is_that_of_the_exact_batch() -> None:
    told = reconfigured(SEED, restarts=0, off_u=1.0)
    assert (told.windows, told.taken, told.held, told.status) == (18, 18, 0, "VALID")
    assert np.all(told.least_u_main_pct > NEARLY * exact_batch_pct(1))
    assert np.all(told.u_main_pct < 1.02 * exact_batch_pct(1))
    assert np.all(np.abs(told.errors[[0, 4, 8]]) < 2.0)


def test_a_restart_with_the_same_configuration_changes_nothing() -> None:
    installation = drawn(SEED)
    houses = [House(installation.building, installation.config) for _ in range(2)]
    for visit in range(4):
        for house in houses:
            house.visit()
        if visit == 1:
            houses[1].restart(installation.config)
    whole, restarted = (house.told() for house in houses)
    np.testing.assert_allclose(restarted.errors, whole.errors, atol=0.05)
    np.testing.assert_allclose(restarted.u_main_pct, whole.u_main_pct, rtol=1e-3)


def test_changed_configurations_count_the_error_of_a_reference_once() -> None:
    told = reconfigured(SEED, restarts=4, off_u=1.0)
    assert np.all(told.least_u_main_pct > NEARLY * exact_batch_pct(1))


def test_a_reference_that_comes_back_is_the_same() -> None:
    told = swapped(SEED, swaps=4, off_u=1.0)
    assert np.all(told.least_u_main_pct > NEARLY * exact_batch_pct(2))


def test_every_line_of_the_table_has_a_row() -> None:
    told = touched.one((0, 0))
    rows = touched.table([[told]] * len(touched.LINES)).splitlines()
    assert len(rows) == 2 + len(touched.LINES)
    assert {row.count("|") for row in rows} == {11}
    assert "| 1 | 18 | 18 / 0 (at most 1) / 0 | 0 |" in rows[2]
