"""Windows of a sensor at rest: motion and knocks are left out, and a sensor that never rests is refused."""

from __future__ import annotations

import numpy as np

from calib.excitation.windows import rest_sd, rest_window
from calib.geometry import at_rest

RATE_HZ = 500.0


def resting(hands: bool, noise: float = 0.02, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    n = int(6 * RATE_HZ)
    V = np.array([0.1, -0.2, 9.8]) + noise * rng.normal(size=(n, 3))
    if hands:
        V[: int(1.0 * RATE_HZ)] += 2 * np.sin(np.arange(int(RATE_HZ)) / 9.0)[:, None]
    return np.arange(n) / RATE_HZ, V


REST = at_rest([0.0, 0.0, 9.81])


def test_a_rest_is_used_without_the_hands() -> None:
    t, V = resting(hands=True)
    window = rest_window(REST, t, V)
    assert window.used, window.reason
    assert window.kind == "rest"
    assert 1.0 < window.start_s < 1.8
    mean = window.sums.count @ window.sums.mean / window.sums.count.sum()
    np.testing.assert_allclose(mean, [0.1, -0.2, 9.8], atol=5 * 0.02 / np.sqrt(2000))


def test_a_sensor_that_never_rests_is_refused() -> None:
    t, V = resting(hands=False)
    V = V + np.cumsum(np.random.default_rng(2).normal(0, 0.05, V.shape), axis=0)
    window = rest_window(REST, t, V, floor=np.full(3, 0.02))
    assert not window.used
    assert "at rest" in window.reason


def test_a_sensor_that_shakes_all_the_time_is_told_by_its_other_rests() -> None:
    t, V = resting(hands=False, noise=0.5)
    floor = rest_sd(resting(hands=True, seed=4)[1], RATE_HZ)
    assert floor is not None
    np.testing.assert_allclose(floor, 0.02, rtol=0.1)
    assert rest_window(REST, t, V).used
    window = rest_window(REST, t, V, floor=floor)
    assert not window.used
    assert "times that in other positions" in window.reason


def test_a_rest_of_few_points_is_refused() -> None:
    t, V = resting(hands=False)
    window = rest_window(REST, t[:40], V[:40])
    assert not window.used


def test_knocks_in_a_rest_are_left_out() -> None:
    t, V = resting(hands=False)
    V[1500] += 0.2  # 10 SD, too little for its block to be no rest
    assert rest_window(REST, t, V).left_out == 1
    assert rest_window(REST, t, V, leave_out=False).left_out == 0
