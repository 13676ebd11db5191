"""Type A of windows: scores of segments with a known correlation, and the noise of a window with a known one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.estimate.rows import NoiseScores
from calib.windows.record import Record
from calib.windows.type_a import LEVELS, SUMS, scattered, score_sums
from tests.building_windows import building_window
from tests.clamp_windows import S_TRUE

LEVEL = (0.1, 0.1, 0.1)
NO_SCORES = np.zeros((2, LEVELS, SUMS))


def scores(seed: int, windows: int, segments: int, rho: float, size: int = 1) -> np.ndarray:
    """Of variance 1, with this correlation of neighbours and none beyond; each window's sum to zero."""
    noise = np.random.default_rng(seed).normal(size=(windows, segments + 1, size))
    share = 0.0 if rho == 0.0 else (1.0 - np.sqrt(1.0 - 4.0 * rho**2)) / (2.0 * rho)
    own = (noise[:, 1:] + share * noise[:, :-1]) / np.sqrt(1.0 + share**2)
    return own - own.mean(axis=1, keepdims=True)


@pytest.mark.parametrize("rho", [0.0, 0.2, 0.3])
def test_the_variance_of_a_window_of_few_correlated_segments_is_unbiased(rho: float) -> None:
    """Of five segments, whose scores sum to zero, a plain mean of products would be off by 0.2 and more."""
    found = scattered(score_sums([scores(1, 20000, 5, rho)]))
    assert found is not None
    assert found.variance == pytest.approx(5.0 * (1.0 + 2.0 * rho * (1.0 - 1.0 / 5.0)), rel=0.02)


def test_a_variance_with_the_covariance_of_neighbours_has_fewer_degrees_of_freedom_than_scores() -> None:
    """600 drawn variances scatter as those of n degrees of freedom do, whose variance is 2 / n; n known to 6 %. What is
    told may be 1.3 times too much; without the noise of the covariance it would be three times as much."""
    found = [scattered(score_sums([scores(seed, 40, 20, 0.3)])) for seed in range(600)]
    variance, told = np.transpose([(one.variance, one.degrees_of_freedom) for one in found if one is not None])
    shown = 2.0 * variance.mean() ** 2 / variance.var()
    assert 0.8 * shown < told.mean() < 1.3 * shown


def test_where_no_segments_tell_it_slopes_and_means_scatter_as_white_noise_makes_them() -> None:
    nothing = replace(Record.of(building_window(np.random.default_rng(3), level_mps2=LEVEL), 0.0), scores=NO_SCORES)
    *_, pooled = NoiseScores.around([nothing, nothing])
    assert (pooled.slopes, pooled.means, pooled.degrees_of_freedom) == (1.0, 1.0, 0.0)


def test_the_noise_of_a_window_is_that_of_its_points() -> None:
    random = np.random.default_rng(1)
    own = Record.of(building_window(random, level_mps2=LEVEL, noise_mps2=0.02), 0.0)
    np.testing.assert_allclose(own.noise, 0.02, rtol=0.05)  # 3000 points: 1.3 % is one standard deviation
    # Segments move by their own part of the motion; what is left of them scatters as white noise does.
    (pooled,) = NoiseScores.around([own])
    assert 0.5 < pooled.means < 1.5
    assert 0.5 < pooled.slopes < 1.5


def test_the_noise_of_the_reference_is_part_of_the_residuals_once() -> None:
    """It is subtracted from the power of the motion, and the sensor does not follow it."""
    random = np.random.default_rng(2)
    window = building_window(random, level_mps2=LEVEL, noise_mps2=0.005, reference_noise_mps2=0.02)
    noisy = replace(window, reference_noise=np.array([[0.02] * 3, [0.0] * 3]))
    expected = np.hypot(0.005, 0.02 * np.linalg.norm(S_TRUE, axis=1))
    np.testing.assert_allclose(Record.of(noisy, 0.0).noise, expected, rtol=0.05)
