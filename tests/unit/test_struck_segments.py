"""Windows in which knocks lie together: their segments are left out, the others are used."""

from __future__ import annotations

import numpy as np
import pytest

from calib.excitation.windows import Points, motion_windows
from tests.unit.test_excitation import POSE, only, points


def hammered(data: Points, first: int, stop: int) -> Points:
    """The sensor is hit again and again from one sample to another; the reference does not feel it."""
    random, V = np.random.default_rng(12), data.V.copy()
    V[first:stop] += 8.0 * random.normal(size=(stop - first, 3))
    return data._replace(V=V)


@pytest.mark.parametrize(
    ("first", "stop", "begin_s", "end_s"),
    [(3200, 4000, 0.0, 6.4), (0, 700, 1.4, 8.0), (1500, 2250, 0.0, 8.0)],
    ids=["end", "beginning", "middle"],
)
def test_knocks_that_lie_together_cost_their_segments_alone(
    first: int, stop: int, begin_s: float, end_s: float
) -> None:
    data = hammered(points(), first, stop)
    window = only(motion_windows(POSE, data))
    assert window.used, window.reason
    # What is used begins and ends with a segment of 0.5 s.
    np.testing.assert_allclose([window.start_s, window.stop_s], [100.0 + begin_s, 100.0 + end_s], atol=0.5)
    assert stop - first <= window.left_out <= stop - first + 2 * 250
    assert window.points == 4000 - window.left_out
    assert window.numbers["dropped_points"] >= stop - first - 2 * 250
    assert window.numbers["left_out_pct"] < 5.0
    assert window.numbers["drift_mps2"] < 0.02
    # The sums are those of the sound samples.
    whole = only(motion_windows(POSE, points()))
    own, all_ = (w.sums.scatter.sum(axis=0)[2:, 2:].trace() / w.points for w in (window, whole))
    assert own == pytest.approx(all_, rel=0.02)
    kept = only(motion_windows(POSE, data, leave_out=False))
    assert (kept.used, kept.points, kept.left_out) == (False, 4000, 0)


def test_of_a_window_knocked_almost_throughout_too_little_is_left() -> None:
    window = only(motion_windows(POSE, hammered(points(), 20, 4000)))
    assert not window.used


@pytest.mark.parametrize("seed", range(10))
def test_knocks_spread_all_over_refuse_the_window_at_a_low_rate_too(seed: int) -> None:
    """At 50 Hz a segment has 25 points: of 8 % that are struck here and there, hardly a segment has many."""
    data = points(40.0)
    slow = data.at(slice(None, None, 10))
    out = np.random.default_rng(seed).random(len(slow.V)) < 0.08
    window = only(motion_windows(POSE, slow._replace(V=slow.V + np.where(out, 5.0, 0.0)[:, None])))
    assert not window.used
    assert "of the points are knocks" in window.reason
