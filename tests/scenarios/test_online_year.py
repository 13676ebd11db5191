"""Three months of a year in a building, with a short window each day: the step is found, all else stays.

docs/online-evidence.md has the whole year with a window each hour (`python -m benchmarks.online year`).
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from benchmarks.online import year
from benchmarks.online.year import Year
from hw.virtual.building import DAY_S, Building

pytestmark = pytest.mark.thorough  # half a minute; `test_online_drift.py` stays in `make test`
DAYS = range(105, 195)  # the step is on day 150
SEED = 1


def world(elsewhere: float) -> Building:
    return Building(year.quicker(year.parameters(SEED, elsewhere), DAY_S, 20.0), SEED)


@cache
def followed(elsewhere: float) -> Year:
    return year.whole(world(elsewhere), DAYS)


@pytest.mark.parametrize("elsewhere", [0.0, 0.3])
def test_a_step_of_one_per_cent_is_found_and_followed(elsewhere: float) -> None:
    building, seen = world(elsewhere), followed(elsewhere)
    found = seen.step_found_after(building)
    assert found is not None
    assert found <= 10
    after = np.array(seen.time_s) > year.settled_s(building)
    assert after.sum() > 15
    assert np.abs(np.array(seen.syy_error)[after]).max() < 0.003
    before = np.array(seen.time_s) < year.STEP_DAY * DAY_S
    assert before.sum() > 30
    assert np.abs(np.array(seen.syy_error)[before]).max() < 0.003  # as good before the step as after it
    assert seen.alarms_before() == []


@pytest.mark.parametrize("elsewhere", [0.0, 0.3])
def test_the_mean_output_is_right_and_q_within_its_uncertainty(elsewhere: float) -> None:
    seen = followed(elsewhere)
    assert np.abs(seen.mean_error_mps2).max() < 2e-3
    # Three axes of one sensor: with probability 0.96 all stay within 2.5 u.
    assert np.all(np.abs(seen.offset_error) < 2.5 * np.array(seen.u_offset))
    # The data determine Q only as well as tilt and gravity are known: 0.1 deg is 17 mm/s2 on a horizontal axis.
    assert np.min(np.array(seen.u_offset)[:, :2]) > np.deg2rad(0.1) * 9.8


def test_what_was_not_excited_stays_as_it_was() -> None:
    columns = np.array(followed(0.0).columns)
    assert np.abs(columns - columns[0]).max() < 1e-12


def test_with_other_motion_the_other_columns_change() -> None:
    assert np.abs(np.array(followed(0.3).columns) - followed(0.0).columns[0]).max() > 1e-3
    assert min(followed(0.3).u_syy) > 0.7e-3


def test_no_number_of_windows_makes_it_better_known_than_the_reference() -> None:
    assert min(followed(0.0).u_syy) > 0.7e-3
    assert followed(0.0).u_syy[-1] > 1e-3  # motion along the reference's y only: u of that channel is 0.1 %
