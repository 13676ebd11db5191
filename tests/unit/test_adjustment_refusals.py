"""What the adjustment refuses, and that it says why with numbers."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from calib.adjustment.adjustment import Adjustment, adjust
from calib.estimate.nuisances import Priors
from calib.model import Pose, Window
from tests.clamp_windows import S_TRUE, Faults, clamp_points, window_of

DEGREE = np.deg2rad(1.0)
ORDINARY = Faults(theta_rad=0.2 * DEGREE, offset_mps2=0.05)


def _nominal(size: float = 1.0, u: float = 0.2, u_transverse: float = 0.03) -> Priors:
    diagonal = np.eye(3).ravel() > 0
    return replace(
        Priors(),
        parameters=np.concatenate([size * np.eye(3).ravel(), np.zeros(3)]),
        covariance=np.diag([*(size * np.where(diagonal, u, u_transverse)) ** 2, np.inf, np.inf, np.inf]),
    )


def _turned(windows: list[Window], static: float = 1.0, polarity: float = 1.0) -> list[Window]:
    """The same data with poses that say the opposite."""
    return [
        replace(
            w, pose=replace(w.pose, direction=polarity * w.pose.direction, gravity_mps2=static * w.pose.gravity_mps2)
        )
        for w in windows
    ]


def _only_reason(found: Adjustment) -> str:
    assert len(found.reasons) == 1, found.reasons
    return found.reasons[0]


@pytest.mark.parametrize("alphas_deg", [(0.0, 90.0), (30.0, 210.0), (0.0, 180.0)])
def test_two_alphas_are_refused_with_the_rank(alphas_deg):
    found = adjust(clamp_points(np.random.default_rng(1), ORDINARY, alphas_deg=alphas_deg).windows)
    assert found.rank == 3
    assert "rank 3 of 4" in _only_reason(found)


def test_one_alpha_is_refused_with_the_rank():
    found = adjust(clamp_points(np.random.default_rng(2), ORDINARY, alphas_deg=(30.0,)).windows)
    assert "rank 2 of 4" in _only_reason(found)


@pytest.mark.two_cases
@pytest.mark.parametrize("priors", [Priors(), Priors.none(), _nominal()])
def test_z_outward_with_the_printed_signs_names_the_sign(priors):
    windows = _turned(clamp_points(np.random.default_rng(3), ORDINARY).windows, static=-1.0)
    assert "the static sign (gravity) reversed" in _only_reason(adjust(windows, priors))


@pytest.mark.thorough
def test_a_reference_with_turned_polarity_is_named_where_the_sensor_is_known():
    windows = _turned(clamp_points(np.random.default_rng(4), ORDINARY).windows, polarity=-1.0)
    assert "the polarity of the reference reversed" in _only_reason(adjust(windows, _nominal()))


@pytest.mark.thorough
def test_both_turned_are_named_where_the_sensor_is_known():
    windows = _turned(clamp_points(np.random.default_rng(5), ORDINARY).windows, static=-1.0, polarity=-1.0)
    assert "the static sign and the polarity" in _only_reason(adjust(windows, _nominal()))


@pytest.mark.slow
def test_right_signs_are_not_refused():
    """Ordinary recordings with fixed seeds: at one false alarm in a thousand, 99 % of such sets have none."""
    refused = [
        adjust(clamp_points(np.random.default_rng([6, seed]), ORDINARY).windows, _nominal()).reasons
        for seed in range(12)
    ]
    assert refused == [()] * 12


@pytest.mark.thorough
def test_swapped_axes_contradict_the_nominal():
    windows = clamp_points(np.random.default_rng(7), ORDINARY, S=S_TRUE[[1, 0, 2]]).windows
    assert "Sxx is 0.01" in _only_reason(adjust(windows, _nominal())) or "expected" in _only_reason(
        adjust(windows, _nominal())
    )


@pytest.mark.slow
def test_a_sensitivity_far_from_nominal_is_refused_with_the_numbers():
    found = adjust(clamp_points(np.random.default_rng(8), ORDINARY).windows, _nominal(size=2.0, u=0.1))
    assert "contradict" in _only_reason(found)
    assert "2 with u 0.2 was expected" in _only_reason(found)


@pytest.mark.parametrize("wrong", [0.1, -0.1])
def test_a_contradiction_of_the_prior_has_the_square_of_the_deviation(wrong):
    """S is known to 0.01 of each element, and one of them is 10 u off: chi-squared is 100, whichever the sign."""
    windows = clamp_points(np.random.default_rng(9), Faults(noise_mps2=0.001)).windows
    stated = np.append(S_TRUE.ravel(), np.zeros(3)) + wrong * np.eye(12)[4]
    covariance = np.diag([1e-4] * 9 + [np.inf] * 3)
    reason = _only_reason(adjust(windows, replace(Priors.none(), parameters=stated, covariance=covariance)))
    told = re.search(r"chi-squared ([0-9.]+), .*; (\w+) is .* with u ([0-9.]+) was expected", reason)
    assert told is not None, reason
    assert (float(told[1]), told[2], told[3]) == (pytest.approx(100.0, rel=0.02), "Syy", "0.01")


def test_what_the_prior_says_better_than_the_data_is_not_determined_by_them():
    """Known to 0.01 % beforehand: angles of 0.2 deg cannot halve that, so no main sensitivity is determined."""
    known = _nominal(u=1e-4, u_transverse=1e-4)
    known = replace(known, parameters=np.concatenate([S_TRUE.ravel(), np.zeros(3)]))
    found = adjust(clamp_points(np.random.default_rng(9), Faults(offset_mps2=0.05)).windows, known)
    assert not found.calibration.determined[[0, 4, 8]].any()
    u = found.calibration.standard_uncertainty[[0, 4, 8]]
    assert ((u > 0.5e-4) & (u <= 1e-4)).all()
    assert (np.abs(np.diag(found.calibration.sensitivity - S_TRUE)) <= 4 * u).all()


def _orbit(frequencies_hz: tuple[float, ...]) -> Window:
    random = np.random.default_rng(10)
    t = np.arange(2500) / 250.0
    u, du = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    for f in frequencies_hz:
        w = 2.0 * np.pi * f
        u[:, :2] += 5.0 * np.column_stack([np.cos(w * t), np.sin(w * t)])
        du[:, :2] += 5.0 * w * np.column_stack([-np.sin(w * t), np.cos(w * t)])
    V = u @ S_TRUE.T + 0.02 * random.normal(size=u.shape)
    return window_of(Pose("beside", np.eye(3), np.full(3, np.nan)), u, du, V, 10)


def test_planar_circular_motion_at_one_frequency_is_refused_unless_the_lag_is_known():
    reason = _only_reason(adjust([_orbit((3.0,))]))
    assert "rank 2 of 4" in reason
    assert "the lag" in reason
    known = adjust([_orbit((3.0,))], replace(Priors(), lag_s=1e-4))
    assert known.reasons == ()
    np.testing.assert_allclose(known.calibration.sensitivity[:, :2], S_TRUE[:, :2], rtol=0, atol=0.01)


def test_planar_motion_at_two_frequencies_parts_lag_and_rotation():
    found = adjust([_orbit((3.0, 5.0))])
    assert found.reasons == ()
    np.testing.assert_allclose(found.calibration.sensitivity[:, :2], S_TRUE[:, :2], rtol=0, atol=0.01)
    assert np.isnan(found.calibration.sensitivity[:, 2]).all()


@pytest.mark.slow
def test_a_misfit_of_the_size_of_the_signal_is_refused():
    """A sensor that was turned by 40 deg on the clamp in one of five positions: no S a + Q explains that."""
    faults = Faults(alpha_rad={300.0: 40.0 * DEGREE}, offset_mps2=0.05)
    windows = clamp_points(
        np.random.default_rng(11), faults, alphas_deg=(0.0, 30.0, 120.0, 210.0, 300.0), repetitions=1
    ).windows
    assert any("unexplained" in reason or "contradict" in reason for reason in adjust(windows, _nominal()).reasons)


def _through(windows: list[Window], matrix: np.ndarray) -> list[Window]:
    """The same windows with the outputs V times `matrix` (3, 3), the reference as it is."""
    m = windows[0].sums.reference_channels
    full = np.eye(2 * m + 3)
    full[2 * m :, 2 * m :] = matrix
    return [
        replace(w, sums=replace(w.sums, mean=w.sums.mean @ full.T, scatter=full @ w.sums.scatter @ full.T))
        for w in windows
    ]


def _reference_times(windows: list[Window], factor: float) -> list[Window]:
    scale = np.array([factor, factor, 1.0, 1.0, 1.0])
    return [
        replace(w, sums=replace(w.sums, mean=w.sums.mean * scale, scatter=w.sums.scatter * np.outer(scale, scale)))
        for w in windows
    ]


@pytest.mark.two_cases
@pytest.mark.parametrize("factor", [1.2, 0.8, 2.0])
def test_a_reference_that_gravity_contradicts_is_refused_without_a_nominal(factor):
    windows = _reference_times(clamp_points(np.random.default_rng(20), ORDINARY).windows, factor)
    reason = _only_reason(adjust(windows))
    assert "the data contradict the stated values: " in reason
    assert "its standard uncertainty was stated as" in reason
    assert not adjust(windows, replace(Priors(), reference=0.5)).reasons


@pytest.mark.slow
def test_nuisances_drawn_from_their_priors_pull_as_such():
    """Pull over its limit in 20 sound recordings: a twice too small spread would bring one above 1."""
    pulls = []
    for seed in range(20):
        random = np.random.default_rng([21, seed])
        alpha = {a: float(random.normal(0.0, 0.2 * DEGREE)) for a in (0.0, 30.0, 120.0, 210.0)}
        faults = Faults(float(random.normal(0.0, 0.2 * DEGREE)), float(random.normal(0.0, 0.1 * DEGREE)), alpha, 0.05)
        pulls.append(adjust(clamp_points(random, faults).windows).nuisance_pull)
    assert 0.5 < np.median(pulls) < 2.5
    assert max(pulls) < 4.5  # of some seven directions: one sound recording in 2e4 is beyond


@pytest.mark.parametrize(
    ("factors", "output"), [((0.0, 1.0, 1.0), "output x is dead"), ((1.0, 1.0, 1e-3), "output z is dead")]
)
def test_a_dead_output_is_refused_without_a_nominal(factors, output):
    windows = _through(clamp_points(np.random.default_rng(22), Faults()).windows, np.diag(factors))
    assert adjust(windows, Priors.none()).reasons[0].startswith(output)


def test_exchanged_outputs_are_a_sensitivity_like_any_other():
    windows = _through(clamp_points(np.random.default_rng(22), Faults()).windows, np.eye(3)[[1, 0, 2]])
    found = adjust(windows, Priors.none())
    assert found.reasons == ()
    assert found.calibration.sensitivity[0, 1] > 0.9
