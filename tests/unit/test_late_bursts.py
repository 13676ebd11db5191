"""Seconds in which the arrivals of a device are late: its samples have the times that the others tell, and are used.

Where samples are lost that nobody counts, what is left of the window is used.
"""

from __future__ import annotations

import numpy as np
import pytest

from agent.core.events import CalibrationUpdate, Result, StatusChange, WindowReport
from benchmarks.late_bursts import LASTS_S, late, lossy
from benchmarks.online.node import RATE_HZ, Stated, Timing, node
from benchmarks.online.runner import Run, visits

WINDOW_S, WINDOWS = 30.0, 10
GUARD_S = 0.5  # at the begin of the first window
SINCE_S = np.array([131.0, 173.0, 204.0, 245.0])  # at the begin, in the middle and at the end of windows


@pytest.mark.slow
@pytest.mark.parametrize("device", ["sensor", "reference"])
def test_every_window_is_used_right_and_tells_how_many_samples_were_late(device: str) -> None:
    drawn = node(3, all_axes=True, stated=Stated(lag_s=0.02), timing=Timing(WINDOW_S, 0.0, WINDOWS))
    run, results = Run(drawn.config), list[Result]()
    for event in late(visits(drawn.building, range(WINDOWS)), SINCE_S, device):
        results += run.feed(event)
    windows = [r for r in results if isinstance(r, WindowReport)]
    assert [w.used for w in windows] == [True] * len(windows)
    assert {r.status for r in results if isinstance(r, StatusChange)} <= {"UNCALIBRATED", "VALID"}
    name = "late_samples" if device == "sensor" else "reference_late_samples"
    told = np.array([w.numbers.get(name, 0.0) for w in windows])
    starts_s = GUARD_S + WINDOW_S * np.arange(len(windows))[:, None]
    within_s = np.minimum(starts_s + WINDOW_S, SINCE_S + LASTS_S) - np.maximum(starts_s, SINCE_S)
    np.testing.assert_allclose(
        told, RATE_HZ * within_s.clip(0.0).sum(axis=1), atol=3 * 32
    )  # a burst has 32 samples; up to four ends
    update = [r for r in results if isinstance(r, CalibrationUpdate)][-1]
    true = drawn.building.truth(run.now_s)
    error = np.append(update.sensitivity, update.offset) - np.append(true.sensitivity, true.offset_at_mean)
    assert np.max(np.abs(error) / update.standard_uncertainty) < 3.5  # 12 errors: beyond in one of 180 runs


@pytest.mark.slow
def test_of_a_window_in_which_samples_are_lost_uncounted_the_longest_part_is_used() -> None:
    drawn = node(3, all_axes=True, stated=Stated(lag_s=0.02), timing=Timing(WINDOW_S, 0.0, WINDOWS))
    run, results = Run(drawn.config), list[Result]()
    for event in lossy(visits(drawn.building, range(WINDOWS)), np.array([160.0, 222.0])):
        results += run.feed(event)
    windows = [r for r in results if isinstance(r, WindowReport)]
    assert [w.used for w in windows] == [True] * len(windows)
    assert not [r for r in results if isinstance(r, StatusChange) and "shifted" in r.reason]
    told = [w.numbers.get("misplaced_samples", 0.0) for w in windows]
    assert [count > 0.0 for count in told] == [k in (5, 7) for k in range(len(windows))]
    for k, lost_s in ((5, 160.0), (7, 222.0)):  # before, the clock is that of more than a quarter of a minute
        assert lost_s - 4.0 < windows[k].stop_s < lost_s + 0.1
        after_s = GUARD_S + WINDOW_S * (k + 1) - lost_s
        assert RATE_HZ * (after_s - 1.0) < told[k] < RATE_HZ * (after_s + 4.0)
    update = [r for r in results if isinstance(r, CalibrationUpdate)][-1]
    true = drawn.building.truth(run.now_s)
    error = np.append(update.sensitivity, update.offset) - np.append(true.sensitivity, true.offset_at_mean)
    assert np.max(np.abs(error) / update.standard_uncertainty) < 3.5
