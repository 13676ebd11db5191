"""The adjustment finds what is there, says how well, and gives nothing that the windows do not hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.adjustment.adjustment import adjust
from calib.estimate.nuisances import Applied, Priors
from calib.model import Pose
from tests.clamp_windows import G_MPS2, Q_TRUE, S_TRUE, TRUTH, Faults, clamp_points, window_of

DEGREE = np.deg2rad(1.0)
FREE_LAG = Priors.none().with_values({"lag_s": 0.02})
UNKNOWN = np.full(3, np.nan)


def _value(found, name):
    return next(n for n in found.nuisances if n.name == name)


@pytest.mark.parametrize("alphas_deg", [(0.0, 30.0, 120.0, 210.0), (0.0, 5.0, 10.0)])
def test_with_every_nuisance_fixed_it_is_plain_method_3(alphas_deg):
    points = clamp_points(np.random.default_rng(1), alphas_deg=alphas_deg)
    found = adjust(points.windows, Priors.none())
    design = np.column_stack([points.a, np.ones(len(points.a))])
    solution = np.linalg.lstsq(design, points.V, rcond=None)[0]
    expected = np.concatenate([solution[:3].T.ravel(), solution[3]])
    np.testing.assert_allclose(found.mean[:12], expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_lag_of_5_ms_is_found_and_costs_nothing():
    found = adjust(clamp_points(np.random.default_rng(2), Faults(lag_s=0.005)).windows, FREE_LAG)
    lag = _value(found, "lag")
    assert lag.value == pytest.approx(0.005, abs=4 * lag.standard_uncertainty + 2e-6)  # (omega tau)^4 terms: 1e-6 s
    assert lag.standard_uncertainty < 1e-5
    np.testing.assert_allclose(found.mean[:9], TRUTH[:9], rtol=0, atol=4e-4)  # 4 u of white noise; plain is off by 4e-3


def test_a_theta_half_a_degree_off_is_found_through_gravity():
    priors = replace(FREE_LAG, theta_rad=DEGREE)
    found = adjust(clamp_points(np.random.default_rng(3), Faults(theta_rad=0.5 * DEGREE)).windows, priors)
    theta = _value(found, "theta")
    assert theta.value == pytest.approx(0.5 * DEGREE, abs=0.01 * DEGREE)
    assert np.all(np.abs(found.mean[:12] - TRUTH) < 4 * found.calibration.standard_uncertainty)


def test_what_the_front_end_took_out_is_reported_in_total():
    windows = clamp_points(np.random.default_rng(4), Faults(lag_s=0.001)).windows
    alone = _value(adjust(windows, FREE_LAG), "lag")
    total = _value(adjust(windows, FREE_LAG, Applied(lag_s=0.004)), "lag")
    assert total.value == pytest.approx(alone.value + 0.004, abs=1e-7)


def test_a_common_alpha_error_turns_s_and_leaves_no_trace():
    """The frame turns by it: u must hold it, S S' must not feel it, and the residual shows nothing."""
    turned = clamp_points(np.random.default_rng(5), Faults(alpha_common_rad=0.3 * DEGREE)).windows
    found = adjust(turned, replace(FREE_LAG, alpha_common_rad=0.3 * DEGREE))
    S = found.calibration.sensitivity
    assert np.abs(S - S_TRUE).max() > 0.004  # 0.3 deg of a main sensitivity
    np.testing.assert_allclose(found.invariant, S_TRUE @ S_TRUE.T, rtol=0, atol=1e-3)  # noise alone, 4 u
    assert found.chi2_degrees_of_freedom / 3.0 < found.chi2 < 3.0 * found.chi2_degrees_of_freedom
    u = found.calibration.standard_uncertainty[:9].reshape(3, 3)
    assert u[0, 1] == pytest.approx(0.3 * DEGREE * S_TRUE[0, 0], rel=0.05)


def test_the_budget_adds_up_and_names_the_largest_source():
    faults = Faults(theta_rad=0.2 * DEGREE, offset_mps2=0.05)
    found = adjust(clamp_points(np.random.default_rng(6), faults).windows, replace(Priors(), transverse=0.0))
    squares = np.sum([c**2 for c in found.contributions.values()], axis=0)
    np.testing.assert_allclose(squares, np.diag(found.covariance)[:12], rtol=1e-9)
    largest = max(found.contributions, key=lambda source: found.contributions[source][0])
    assert largest == "alpha by position"  # 0.2 deg against 0.02 m/s2 of noise
    assert found.contributions["type A"][0] < 0.1 * found.contributions[largest][0]


def test_an_offset_that_scatters_more_than_stated_counts_as_it_scatters():
    """Ten recordings with 0.3 m/s2 where 0.01 is stated: estimated within 25 %, and u of Q grows with it."""
    seen = []
    for seed in range(10):
        windows = clamp_points(np.random.default_rng([7, seed]), Faults(offset_mps2=0.3)).windows
        found = adjust(windows, replace(FREE_LAG, offset_mps2=0.01))
        seen.append(found.offset_scatter_mps2)
        assert found.contributions["offset between windows"][11] >= found.offset_scatter_mps2 / np.sqrt(12) * 0.99
        assert found.coverage_factor > 2.02  # a scatter estimated from some twenty residuals, not known
    assert np.sqrt(np.mean(np.square(seen))) == pytest.approx(0.3, rel=0.25)


@pytest.mark.slow
def test_coloured_residuals_are_not_taken_for_white():
    """AR(1) 0.99, 40 recordings: each Q within its own u as often as it should (chi-squared over 120 values)."""
    white, pulls = [], []
    for seed in range(40):
        faults = Faults(phi=0.96, noise_mps2=0.02)  # 0.99 at 1 kHz is 0.96 at the 250 Hz of these windows
        windows = clamp_points(np.random.default_rng([8, seed]), faults).windows
        found = adjust(windows, FREE_LAG)
        u = found.calibration.standard_uncertainty
        pulls.append((found.mean[9:12] - Q_TRUE) / u[9:12])
        white.append(u[9])
    # 99.9 % band of the root mean square of 120 normal values, widened for u's own scatter (36 degrees of freedom)
    assert 0.75 < np.sqrt(np.mean(np.square(pulls))) < 1.30
    plain = 0.02 / np.sqrt(12 * 500) * 2.0  # at most twice: the geometry's part
    assert np.mean(white) > 3.0 * plain


def test_one_direction_gives_one_column():
    random = np.random.default_rng(9)
    t = np.arange(2500) / 250.0
    u, du = 5.0 * np.sin(18.85 * t)[:, None], 5.0 * 18.85 * np.cos(18.85 * t)[:, None]
    V = u @ S_TRUE[:, :1].T + Q_TRUE + 0.02 * random.normal(size=(len(t), 3))
    for gravity in (UNKNOWN, np.array([0.0, 0.0, G_MPS2])):
        found = adjust([window_of(Pose("x", np.array([[1.0], [0.0], [0.0]]), gravity), u, du, V, 6)])
        assert found.reasons == ()
        np.testing.assert_allclose(found.calibration.sensitivity[:, 0], S_TRUE[:, 0], rtol=0, atol=2e-3)
        assert np.isnan(found.calibration.sensitivity[:, 1:]).all()
        assert np.isnan(found.calibration.offset).all()
        assert np.isnan(found.calibration.covariance[1]).all()


def test_a_mounting_rotation_is_carried_in_the_covariance():
    """Tri-axial reference turned by 0.2 deg: S turns with it, u of the transverse elements is 0.2 deg."""
    random = np.random.default_rng(10)
    t = np.arange(5000) / 250.0
    omega = 2.0 * np.pi * np.array([1.3, 2.1, 3.7])
    u, du = np.sin(np.outer(t, omega)), omega * np.cos(np.outer(t, omega))
    V = u @ S_TRUE.T + Q_TRUE + 0.002 * random.normal(size=(len(t), 3))
    found = adjust([window_of(Pose("beside", np.eye(3), UNKNOWN), u, du, V, 20)])
    assert found.reasons == ()
    assert found.calibration.determined.tolist() == [True] * 9 + [False] * 3
    rotation = found.contributions["mounting rotation"][:9].reshape(3, 3)
    assert rotation[0, 1] == pytest.approx(0.2 * DEGREE * 1.02, rel=0.05)
    assert rotation[0, 0] < 0.1 * rotation[0, 1]


def test_no_window_is_an_error():
    windows = [replace(w, used=False) for w in clamp_points(np.random.default_rng(11), repetitions=1).windows]
    with pytest.raises(ValueError, match="no window"):
        adjust(windows)
