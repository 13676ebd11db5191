"""The norm fit: its uncertainty against trials, gravity's own uncertainty, and rests that leave parameters open."""

from __future__ import annotations

import numpy as np
import pytest

from calib.adjustment.norm_fit import norm_fit
from calib.geometry import at_rest
from calib.model import Window, WindowSums
from tests.clamp_windows import Q_TRUE

G_MPS2 = 9.81
S_UPPER = np.array([[1.02, 0.01, -0.02], [0.0, 0.98, 0.005], [0.0, 0.0, 1.01]])
TRIALS = 200
UPPER = [0, 1, 2, 4, 5, 8, 9, 10, 11]


def _rests(
    random: np.random.Generator, directions: np.ndarray, scatter_mps2: float, drift: np.ndarray | float = 0.0
) -> list[Window]:
    """Rests whose means scatter by so much; ways up (W, 3) of any length; Q drifts by `drift` (W, 3)."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    means = G_MPS2 * unit @ S_UPPER.T + Q_TRUE + drift + scatter_mps2 * random.normal(size=unit.shape)
    return [
        Window(float(k), k + 0.9, at_rest([0.0, 0.0, G_MPS2], f"{k}"),
               WindowSums(0, np.array([300.0]), m[None], np.zeros((1, 3, 3))), True, "", 300, 0)
        for k, m in enumerate(means)
    ]  # fmt: skip


@pytest.mark.one_case
@pytest.mark.parametrize("walk_mps2", [0.003, 0.0, 0.02])
def test_u_covers_with_and_without_a_drift_of_q(walk_mps2: float) -> None:
    """Twenty rests, 200 times; Q walks by `walk_mps2` over them. U(Q) covers Q in the middle and at the end."""
    random = np.random.default_rng(70)
    directions = random.normal(size=(20, 3))
    truth = np.append(S_UPPER.ravel(), Q_TRUE)
    inside, at_end = [], []
    for _ in range(TRIALS):
        walk = np.cumsum(random.normal(size=(20, 3)) * walk_mps2 / np.sqrt(19.0), axis=0)
        walk -= 0.5 * (walk[9] + walk[10])
        found = norm_fit(_rests(random, directions, 0.003, walk), G_MPS2)
        value = np.append(found.calibration.sensitivity.ravel(), found.calibration.offset)
        U = found.coverage_factor * found.calibration.standard_uncertainty
        inside.append(np.abs(value - truth)[UPPER] < U[UPPER])
        at_end.append(np.abs(value - truth - np.append(np.zeros(9), walk[-1]))[9:] < U[9:])
    np.testing.assert_array_equal(found.calibration.sensitivity[[1, 2, 2], [0, 0, 1]], 0.0)
    of_s, of_q = np.mean(inside, axis=0)[:6].mean(), np.mean(inside, axis=0)[6:].mean()
    # 95.45 % of 200 runs, six elements that share their noise: within 3 standard deviations of a binomial of 200.
    assert 0.91 < of_s < 0.99, of_s
    assert of_q > 0.91, of_q
    assert np.mean(at_end) > 0.91, np.mean(at_end)


def test_the_drift_of_q_is_told() -> None:
    random = np.random.default_rng(76)
    directions = random.normal(size=(60, 3))
    walk = np.cumsum(random.normal(size=(60, 3)) * 0.03 / np.sqrt(59.0), axis=0)
    assert 0.015 < norm_fit(_rests(random, directions, 0.001, walk), G_MPS2).drift_mps2 < 0.06
    assert norm_fit(_rests(random, directions, 0.001), G_MPS2).drift_mps2 < 0.003


def test_gravity_s_uncertainty_goes_into_s_alone():
    random = np.random.default_rng(71)
    windows = _rests(random, random.normal(size=(20, 3)), 1e-6)
    found = norm_fit(windows, G_MPS2, u_gravity_mps2=0.03)
    u = found.calibration.standard_uncertainty
    np.testing.assert_allclose(u[[0, 4, 8]], np.diag(S_UPPER) * 0.03 / G_MPS2, rtol=1e-3)
    assert np.all(u[9:] < 1e-5)


def test_rests_in_one_plane_are_refused():
    random = np.random.default_rng(72)
    angles = np.arange(12) * np.pi / 6.0
    found = norm_fit(_rests(random, np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles]), 1e-3), G_MPS2)
    assert any("do not determine all 9 parameters" in reason for reason in found.reasons)


def test_a_direction_hardly_tilted_into_is_not_stated():
    """Twelve rests within 0.6 deg of a plane: nobody can say what the third axis is worth; the other two are right."""
    random = np.random.default_rng(75)
    angles = np.arange(12) * np.pi / 6.0
    ways = np.column_stack([np.cos(angles), np.sin(angles), 0.01 * np.cos(3.0 * angles)])
    found = norm_fit(_rests(random, ways, 1e-3), G_MPS2)
    assert found.calibration.determined[[0, 4, 8]].tolist() == [True, True, False]
    assert np.isnan(found.calibration.sensitivity[2, 2])
    np.testing.assert_allclose(np.diag(found.calibration.sensitivity)[:2], np.diag(S_UPPER)[:2], rtol=0, atol=1e-3)


def test_a_rest_that_was_none_is_named():
    random = np.random.default_rng(73)
    windows = _rests(random, random.normal(size=(20, 3)), 0.002)
    windows[7].sums.mean[0] += 3.0
    found = norm_fit(windows, G_MPS2)
    assert any("at 7 s" in reason for reason in found.reasons)


def test_nine_rests_are_too_few():
    random = np.random.default_rng(74)
    with pytest.raises(ValueError, match="10 rests are needed, and 9 were found"):
        norm_fit(_rests(random, random.normal(size=(9, 3)), 0.002), G_MPS2)
