"""Segments whose residuals hang together: the scatter of a window's sum, though each window's own mean is free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.model import Pose, Window
from calib.windows.condense import condense
from tests.clamp_windows import window_of

REST = Pose("rest", np.zeros((3, 0)), np.array([0.0, 0.0, 9.81]))
SEGMENTS, PER_SEGMENT = 6, 20


def _rests(random: np.random.Generator, windows: int, phi: float) -> tuple[list[Window], np.ndarray]:
    """Rests with AR(1) noise of SD 0.02, and their true means' scatter (3,) over that of white noise."""
    n = SEGMENTS * PER_SEGMENT
    out = []
    for _ in range(windows):
        noise = random.normal(size=(n, 3))
        for k in range(1, n):
            noise[k] = phi * noise[k - 1] + np.sqrt(1.0 - phi**2) * noise[k]
        nothing = np.empty((n, 0))
        out.append(window_of(REST, nothing, nothing, 0.02 * noise + [0.1, -0.2, 9.81], SEGMENTS))
    means = np.array([w.sums.count @ w.sums.mean / w.sums.count.sum() for w in out])
    return out, means.var(axis=0) * n / 0.02**2


@pytest.mark.slow
@pytest.mark.parametrize("phi", [0.0, 0.8, 0.9])
def test_the_scatter_of_means_is_the_one_that_400_windows_show(phi):
    """phi 0.9: a correlation time of 10 samples in segments of 20; without their neighbours it is a third too small."""
    windows, shown = _rests(np.random.default_rng(50), 400, phi)
    told = condense(windows).type_a
    expected = (1.0 + phi) / (1.0 - phi)  # of AR(1), many samples; the ends of 120 take up to a tenth of it
    n = SEGMENTS * PER_SEGMENT
    expected -= 2.0 * phi * (1.0 - phi**n) / (n * (1.0 - phi) ** 2)
    # 400 windows show a variance to 7 %, three axes its mean to 4 %: four of those. What is told comes from 2000
    # segments an axis (2 %), but knows of direct neighbours only: at two correlation times a tenth is missing.
    assert shown.mean() == pytest.approx(expected, rel=0.16)
    ratio = np.diag(told.means) * told.noise**2 / 0.02**2
    assert ratio.mean() == pytest.approx(expected, rel=0.14)


def test_filtered_noise_scatters_as_white_noise_of_its_independent_points():
    """A mean over four points leaves a quarter of them independent, and neighbours of segments hardly correlate."""
    random, nothing, n = np.random.default_rng(56), np.empty((SEGMENTS * PER_SEGMENT, 0)), SEGMENTS * PER_SEGMENT
    windows = []
    for _ in range(200):
        white = random.normal(size=(n + 3, 3))
        noise = 0.5 * (white[3:] + white[2:-1] + white[1:-2] + white[:-3])
        windows.append(replace(window_of(REST, nothing, nothing, 0.02 * noise, SEGMENTS), independent=0.25))
    assert np.diag(condense(windows).type_a.means).mean() == pytest.approx(1.0, rel=0.15)


def test_few_segments_tell_few_degrees_of_freedom():
    windows, _ = _rests(np.random.default_rng(51), 4, 0.0)
    assert condense(windows).type_a.degrees_of_freedom <= 4 * (SEGMENTS - 1)


def test_windows_of_one_segment_are_taken_for_white():
    random = np.random.default_rng(52)
    nothing = np.empty((200, 0))
    windows = [window_of(REST, nothing, nothing, random.normal(size=(200, 3)), 1) for _ in range(3)]
    told = condense(windows).type_a
    np.testing.assert_array_equal(told.means, np.eye(3))
    np.testing.assert_allclose(told.noise, 1.0, rtol=0.2)  # 600 samples: 3 % each, six of those


def test_a_window_of_one_segment_beside_coloured_ones_stays_as_it_is():
    """A part of a hold can be as short as that; its neighbours' segments are joined in pairs."""
    windows, _ = _rests(np.random.default_rng(53), 40, 0.97)
    nothing = np.empty((PER_SEGMENT, 0))
    single = np.random.default_rng(54).normal(size=(PER_SEGMENT, 3)) * 0.02
    told = condense([*windows, window_of(REST, nothing, nothing, np.array([0.1, -0.2, 9.81]) + single, 1)]).type_a
    np.testing.assert_allclose(np.diag(told.means), np.diag(condense(windows).type_a.means), rtol=0.1)


def test_windows_with_different_numbers_of_segments_stay_in_their_order():
    random, nothing = np.random.default_rng(55), np.empty((120, 0))
    segments = (6, 3, 6, 1)
    windows = [window_of(REST, nothing, nothing, random.normal(size=(120, 3)), k) for k in segments]
    together = condense(windows)
    for k, window in enumerate(windows):
        alone = condense([window])
        np.testing.assert_array_equal(together.mean_v[k], alone.mean_v[0])
        np.testing.assert_array_equal(together.type_a.noise[k], alone.type_a.noise[0])
