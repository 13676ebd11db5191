"""Lag that differs between windows: with it in the weights S and Q are as uncertain as they are said to be."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from calib.adjustment import adjustment
from calib.adjustment.adjustment import Adjustment, adjust
from calib.adjustment.slope_scatter import SlopeScatter, estimated
from calib.distributions import chi2_quantile
from calib.estimate.nuisances import Priors
from calib.geometry import clamp
from calib.model import Array, Window
from calib.windows.condense import condense
from calib.windows.excited import excited
from calib.windows.sums import window_sums

RATE_HZ, SECONDS, NOISE = 200.0, 8.0, 0.01
FREQUENCIES_HZ = np.array([1.3, 2.9, 4.7, 7.1])
S_TRUE = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
Q_TRUE = np.array([0.3, -0.1, 0.2])
DRAWS, SEED = 10, 35
# Angles are drawn with these, and little else is uncertain: what a wrong weight costs then shows.
PRIORS = Priors(
    angle_rad=2e-3,
    theta_rad=2e-3,
    alpha_common_rad=0.0,
    offset_mps2=0.0,
    reference=0.0,
    transverse=5e-3,
    gravity_mps2=0.0,
)


def windows(rng: np.random.Generator, jitter_s: float) -> list[Window]:
    """Three turns round four positions; angles and sideways motion drawn once, the lag anew for each window."""
    theta_error, sideways = 2e-3 * rng.normal(), 5e-3 * rng.normal(size=2)
    alpha_errors = 2e-3 * rng.normal(size=4)
    t = np.arange(int(RATE_HZ * SECONDS)) / RATE_HZ
    found = []
    for turn in range(3):
        for p, alpha in enumerate(np.deg2rad([0.0, 30.0, 120.0, 210.0])):
            stated = clamp(np.deg2rad(35.0), alpha)
            true = clamp(np.deg2rad(35.0) + theta_error, alpha + alpha_errors[p])
            phase = rng.uniform(0.0, 2.0 * np.pi, len(FREQUENCIES_HZ))
            u, du = motion(t, phase)
            felt, _ = motion(t - 5e-3 - jitter_s * rng.normal(), phase)
            normal = np.cross(true.gravity_mps2, true.direction[:, 0])
            lateral = normal / np.linalg.norm(normal)
            vertical = true.gravity_mps2 / np.linalg.norm(true.gravity_mps2)
            way = true.direction[:, 0] + sideways[0] * lateral + sideways[1] * vertical
            a = felt[:, None] * way + true.gravity_mps2
            V = a @ S_TRUE.T + Q_TRUE + NOISE * rng.normal(size=(len(t), 3))
            sums = window_sums(u[:, None], du[:, None], V, np.arange(0, len(t) + 1, 200))
            found.append(
                Window(turn * 40.0 + p * 10.0, turn * 40.0 + p * 10.0 + 8.0, stated, sums, True, "", len(t), 0)
            )
    return found


def motion(t: Array, phase: Array) -> tuple[Array, Array]:
    omega = 2.0 * np.pi * FREQUENCIES_HZ
    angle = omega * t[:, None] + phase
    return np.asarray(2.0 * np.sin(angle).sum(axis=1)), np.asarray(2.0 * (omega * np.cos(angle)).sum(axis=1))


def errors_over_u(found: Adjustment) -> Array:
    calibration = found.calibration
    error = np.concatenate([(calibration.sensitivity - S_TRUE).ravel(), calibration.offset - Q_TRUE])
    return np.asarray(error / calibration.standard_uncertainty)


def drawn(jitter_s: float) -> list[Adjustment]:
    rng = np.random.default_rng(SEED)
    return [adjust(windows(rng, jitter_s), PRIORS) for _ in range(DRAWS)]


as_they_are = cache(drawn)


def mean_square(found: list[Adjustment]) -> Array:
    return np.asarray(np.mean([errors_over_u(each) ** 2 for each in found], axis=0))


@pytest.mark.slow
@pytest.mark.one_case
@pytest.mark.parametrize("jitter_s", [100e-6, 0.0])
def test_s_and_q_are_as_uncertain_as_said(jitter_s: float) -> None:
    highest = chi2_quantile(1.0 - 1e-3 / 12 / 2, DRAWS) / DRAWS  # 99.9 %, Bonferroni over 12 parameters and 2 sizes
    found = mean_square(as_they_are(jitter_s))
    assert found.max() < highest
    assert found.mean() < 1.5  # of all twelve together, 1.07 where the lag differs: a variance of 1.5 is seen


@pytest.mark.thorough
def test_weighed_as_exact_they_would_not_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adjustment, "SCATTER_TURNS", 0)
    assert mean_square(drawn(100e-6)).max() > 4.0


def test_loadings_are_the_size_of_motion_and_its_rate_over_the_noise() -> None:
    """The mean square of the motion is 2^2 / 2 for each tone, that of its rate omega^2 times as much. Noise of
    4 % of the power of the motion takes 4 % of what the motion shows; a lag takes so much of them from the slope on the
    rate."""
    own = windows(np.random.default_rng(SEED), 0.0)
    data = condense([excited(w) for w in own])
    noisy = np.tile([0.04, 0.0], (len(own), 1))
    found, shown = SlopeScatter.of(data, shares=noisy), np.array([w.pose.direction[:, 0] @ S_TRUE.T for w in own])
    size = np.sqrt(RATE_HZ * SECONDS * 2.0 * np.array([4.0, np.sum((2.0 * np.pi * FREQUENCIES_HZ) ** 2)]))
    corrected, lag = (loading.reshape(len(own), 2, 3) for loading in (found.corrected, found.lag))
    np.testing.assert_allclose(corrected[:, 0] * data.type_a.noise / size[0], 0.04 * shown, rtol=0, atol=0.004)
    np.testing.assert_allclose(lag[:, 1] * data.type_a.noise / size[1], -shown, rtol=0, atol=0.1)


def test_the_scatter_of_lags_is_what_residuals_show_beyond_noise() -> None:
    """Forty windows whose loading is 2, and who are weighed for a scatter of 1/2: residuals of 3 are then twice their
    square of before, which is 18. Noise has the variance 2, and a quarter of each was spent on what was adjusted."""
    along = np.eye(1, 6).repeat(40, axis=0)
    nothing = np.zeros((40, 6))
    stated = SlopeScatter(np.full(40, 0.5), 2.0 * along, np.zeros(40), nothing)
    found = estimated(stated, 3.0 * along, 0.5 * along[..., None], 2.0 * np.eye(6))
    assert found.degrees_of_freedom == pytest.approx(30.0, rel=1e-12)
    np.testing.assert_allclose(found.lag_s, np.sqrt((40 * 18.0 - 30 * 2.0) / (30 * 2.0**2)), rtol=1e-12)


@pytest.mark.slow
def test_the_scatter_found_is_that_put_in() -> None:
    found = [each.lag_scatter_s for each in as_they_are(100e-6)]
    assert np.median(found) == pytest.approx(100e-6, rel=0.2)
    assert adjust(windows(np.random.default_rng(SEED), 0.0), PRIORS).lag_scatter_s < 10e-6


def test_a_stated_scatter_that_is_larger_counts() -> None:
    priors = Priors(lag_window_s=3e-4)
    found = adjust(windows(np.random.default_rng(SEED), 20e-6), priors)
    assert found.lag_scatter_s == 3e-4
    assert found.contributions["lag between windows"].max() > 0.0
