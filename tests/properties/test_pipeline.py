"""The pipeline over runs as they never should be: it goes on, counts on, and is wholly in its snapshot."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from agent.core.events import CalibrationUpdate, Event, Result, StatusChange, WindowReport
from agent.core.pipeline import Pipeline
from tests.properties.happenings import EPOCH_NS, ORIGIN_NS, calm, config, happenings

EVENTS, FEW_EVENTS = 300, 120
CALM_BLOCKS = 30  # of each device: seven windows
LONGEST_S = 1.5  # of the schedule's poses, guards taken off, and a sample
seeds = st.integers(0, 2**32 - 1)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "reference", "events"), [(9, True, FEW_EVENTS), (1, False, EVENTS)])
def test_restored_at_any_event_it_goes_on_alike_and_its_results_follow_from_each_other(
    seed: int, reference: bool, events: int
) -> None:
    check(seed, reference, happenings(seed, events, moving=reference))


@pytest.mark.slow
def test_so_it_is_where_calibrations_come_into_force() -> None:
    results = check(1, True, calm(CALM_BLOCKS))
    updates = [r for r in results if isinstance(r, CalibrationUpdate)]
    assert len(updates) >= 3
    assert np.abs(np.array(updates[-1].sensitivity) - np.eye(3)).max() < 0.02  # of a sensor without an error


@pytest.mark.thorough
@settings(max_examples=2)
@given(seed=seeds, reference=st.booleans())
@example(seed=9, reference=True)  # 10 windows contradict the calibration, of 44
@example(seed=35, reference=True)  # 8 of 32
@example(seed=2, reference=False)
def test_so_it_is_with_more_seeds(seed: int, reference: bool) -> None:
    check(seed, reference, happenings(seed, EVENTS, moving=reference))


def check(seed: int, reference: bool, events: Iterable[Event]) -> list[Result]:
    """A run that is restored now and then gives the results of one that goes on."""
    settings_ = config(reference)
    config_json = settings_.model_dump_json()
    going_on = Pipeline.begin(settings_, "run", ORIGIN_NS, 7, {})
    restored = Pipeline.begin(settings_, "run", ORIGIN_NS, 7, {})
    places = np.random.default_rng(seed)
    results: list[Result] = []
    for event in events:
        if places.random() < 0.2:
            restored = Pipeline.restore(config_json, restored.snapshot())
        new = going_on.step(event)
        assert repr(restored.step(event)) == repr(new)  # NaN equals NaN there
        results += [result for result in new if isinstance(result, Result)]
    assert restored.snapshot() == going_on.snapshot()
    check_order(results)
    return results


def check_order(results: Sequence[Result]) -> None:
    """Results of one run are numbered from 8 on; statuses and windows follow from each other."""
    assert [r.sequence for r in results] == list(range(8, 8 + len(results)))
    assert {(r.run_id, r.sensor) for r in results} == {("run", "s")}
    assert all(r.t_utc_ns > EPOCH_NS - 10**17 for r in results)
    said = [r for r in results if isinstance(r, StatusChange)]
    statuses = [s for s in said if s.before != s.status]  # the others only say more of the one that stands
    assert [s.before for s in statuses] == ["", *(s.status for s in statuses[:-1])]
    windows = [r for r in results if isinstance(r, WindowReport)]
    assert all(a.start_s <= b.start_s for a, b in itertools.pairwise(windows))
    assert all(w.used != bool(w.reason) for w in windows)
    assert all(0 < w.stop_s - w.start_s < LONGEST_S for w in windows)
    assert all(r.identity and all(r.determined) for r in results if isinstance(r, CalibrationUpdate))
