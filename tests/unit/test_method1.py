"""Method 1 on signals made here by hand."""

from __future__ import annotations

from dataclasses import replace
from math import pi, radians

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calib.estimate.nuisances import Priors
from calib.geometry import along, clamp, on_axis
from calib.model import Pose
from calib.paper import method1
from calib.paper.amplitudes import SineRun

S_TRUE = np.array([[1.02, 0.03, -0.02], [0.015, 0.98, 0.025], [-0.03, 0.02, -1.01]])  # z with its polarity turned
G = 9.81
F = 3.0


def run(
    pose: Pose,
    *,
    amplitude: float = 10.0,
    lag_s: float = 0.0,
    velocity: bool = False,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
    sideways: complex = 0.0,
    n: int = 2000,
) -> SineRun:
    """V = S a + Q for a sine along the pose; `sideways` is motion along the axis after the first excited one."""
    t = 20.0 + np.arange(n) / 1000.0
    omega = 2 * pi * F
    turning = np.exp(1j * omega * t)
    direction = pose.direction[:, 0] + sideways * np.roll(pose.direction[:, 0], 1)
    a = (amplitude * (turning * np.exp(-1j * omega * lag_s))[:, None] * direction).real
    v = a @ S_TRUE.T + [0.3, -0.1, G]
    if noise:
        assert rng is not None
        v = v + noise * rng.normal(size=v.shape)
    reference = (amplitude / (1j * omega) * turning).real if velocity else amplitude * turning.real
    return SineRun(t, reference, v, pose, "velocity" if velocity else "acceleration")


def each_axis(**options: object) -> list[SineRun]:
    return [run(on_axis(axis), **options) for axis in "xyz"]  # type: ignore[arg-type]


@pytest.mark.parametrize("velocity", [False, True])
@pytest.mark.parametrize("lag_s", [0.0, 0.004])
def test_columns_are_amplitudes_over_amplitude_whatever_the_lag(velocity: bool, lag_s: float) -> None:
    result = method1.solve(each_axis(velocity=velocity, lag_s=lag_s))
    assert_allclose(result.calibration.sensitivity, S_TRUE, atol=1e-9)  # Eqs. (2)-(4), transverse ones with their sign
    assert_allclose(result.magnitude, np.abs(S_TRUE), atol=1e-9)  # Eq. (1)
    assert_allclose(result.phase_rad, -2 * pi * F * lag_s, atol=1e-8)
    assert np.isnan(result.calibration.offset).all()
    assert result.frequency_hz == pytest.approx(F, abs=1e-9)
    assert result.reasons == ()


def test_an_axis_turned_round_and_one_axis_alone() -> None:
    result = method1.solve([run(along([0.0, -1.0, 0.0]))])
    assert_allclose(result.calibration.sensitivity[:, 1], S_TRUE[:, 1], atol=1e-9)
    assert np.isnan(result.calibration.sensitivity[:, [0, 2]]).all()
    assert list(np.flatnonzero(result.calibration.determined)) == [1, 4, 7]
    assert np.isnan(result.calibration.covariance[0, 0])


def test_what_is_in_quadrature_is_in_the_magnitude_alone() -> None:
    result = method1.solve([run(on_axis("x"), sideways=0.05j)])  # slide also moves along y, a quarter turn ahead
    S = result.calibration.sensitivity
    # the phase of output x itself is turned by S_xy 0.05 / S_xx, 1.5 mrad; its cosine is 1e-6
    assert S[1, 0] == pytest.approx(S_TRUE[1, 0] + 0.05 * S_TRUE[1, 1] * 0.05 * S_TRUE[0, 1] / S_TRUE[0, 0], abs=1e-6)
    assert result.magnitude[1, 0] == pytest.approx(np.hypot(S_TRUE[1, 0], 0.05 * S_TRUE[1, 1]), abs=1e-6)


def test_six_values_a_run_and_their_statistics() -> None:
    rng = np.random.default_rng(1)
    result = method1.solve([run(on_axis("x"), noise=0.02, rng=rng) for _ in range(3)], Priors.none())
    runs = result.repeatability[0, 0]
    assert [r.n for r in runs] == [6, 6, 6]
    # an amplitude from 333 points of SD 0.02: 0.02 sqrt(2/333) / 10 = 0.0155 %; SD of 15 degrees of freedom, 4 SDs
    assert np.sqrt(np.mean([r.s_rel_pct**2 for r in runs])) == pytest.approx(0.0155 / 1.02, rel=4 / np.sqrt(30))


@pytest.mark.slow
def test_type_a_covers() -> None:
    # 200 calibrations of one run; S_xx and S_yx come from independent outputs. |z| <= k, k by 5 or fewer degrees of
    # freedom, in 95.45 % of 400: 99.9 % binomial band 367 .. 394; the normal k = 2 would reach 360.
    rng = np.random.default_rng(2)
    inside = 0
    for _ in range(200):
        result = method1.solve([run(on_axis("x"), noise=0.5, rng=rng)], Priors.none())
        u = np.sqrt(np.diag(result.calibration.covariance))
        off = np.abs(result.calibration.sensitivity[:2, 0] - S_TRUE[:2, 0])
        inside += int(np.sum(off <= result.coverage_factor * u[[0, 3]]))
    assert 367 <= inside <= 394


def test_repetitions_that_scatter_more_than_their_cycles_say_so() -> None:
    scaled = [replace(one, indications=one.indications * k) for one, k in
              ((run(on_axis("x")), k) for k in (0.999, 1.0, 1.001))]  # fmt: skip
    result = method1.solve(scaled, Priors.none())
    assert result.statement.u_type_a[0] == pytest.approx(1.02 * 1e-3 / np.sqrt(3), rel=1e-6)  # SD / sqrt 3
    assert result.statement.freedom_type_a[0] == 2
    assert result.coverage_factor == pytest.approx(4.53, rel=0.05)  # Student's t; the quantile is an approximation at 2


def test_remounted_sensors_average_their_mounting_and_repeated_ones_do_not() -> None:
    priors = Priors(alpha_common_rad=0.0, transverse=0.0)
    once = method1.solve([run(on_axis("x", position="once")) for _ in range(4)], priors)
    anew = method1.solve([run(on_axis("x", position=f"mounting {k}")) for k in range(4)], priors)
    u_once, u_anew = (r.statement.by_source["direction by position"][3] for r in (once, anew))
    assert u_once == pytest.approx(radians(0.2) * 1.02, rel=0.01)  # S_yx moves by S_xx (S_yy unknown: as S_xx)
    assert u_anew == pytest.approx(u_once / 2, rel=1e-6)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (clamp(radians(35), radians(45)), "one axis along the motion, the direction is"),
        (along([np.cos(0.005), np.sin(0.005), 0.0]), "one axis along the motion"),
        (Pose("rest", np.zeros((3, 0)), np.zeros(3)), "uniaxial reference"),
    ],
)
def test_positions_that_are_no_axis_are_refused(pose: Pose, message: str) -> None:
    t = np.arange(1000) / 1000
    with pytest.raises(ValueError, match=message):
        method1.solve([SineRun(t, np.sin(t), np.zeros((1000, 3)), pose)])


def test_data_that_cannot_be_used_are_named() -> None:
    good = run(on_axis("x"))
    with pytest.raises(ValueError, match="position axis x: the signal does not move"):
        method1.solve([SineRun(good.time_s, np.zeros(2000), good.indications, good.pose)])
    with pytest.raises(ValueError, match="position axis x: 1 whole cycle, 2 are needed"):
        method1.solve([run(on_axis("x"), n=500)])
    with pytest.raises(ValueError, match="at least one run"):
        method1.solve([])
    noisy = good.reference + 10 * np.sin(2 * pi * 7.3 * good.time_s)
    reasons = method1.solve([SineRun(good.time_s, noisy, good.indications, good.pose)]).reasons
    assert len(reasons) == 1
    assert "no sine" in reasons[0]
    late = method1.solve([run(on_axis("x"), lag_s=0.25 / F)])
    assert any("its sign cannot be told" in reason for reason in late.reasons)


@pytest.mark.one_case
@pytest.mark.parametrize("rests_s", [(0.9, 0.0), (0.0, 1.3), (0.7, 0.8), (1.45, 0.6)])
@pytest.mark.parametrize("lag_s", [0.0, 0.004])
def test_rests_beside_the_sine_are_left_out(rests_s: tuple[float, float], lag_s: float) -> None:
    """The table moves within the stretch only; it starts and stops at any phase."""
    runs = []
    for whole in each_axis(lag_s=lag_s, n=4000):
        at_s = np.arange(len(whole.time_s)) / 1000.0
        moving = (at_s >= rests_s[0]) & (at_s < 4.0 - rests_s[1])
        rest = np.array([0.3, -0.1, G])
        resting = np.where(moving, whole.reference, 0.0), np.where(moving[:, None], whole.indications, rest)
        runs.append(replace(whole, reference=resting[0], indications=resting[1]))
    result = method1.solve(runs)
    assert result.reasons == ()
    assert_allclose(result.calibration.sensitivity, S_TRUE, atol=1e-9)
    assert all(len(ratio.ratio) >= 3 for ratio in result.ratios)


def test_two_sines_are_no_sine_with_rests() -> None:
    """Trimming must not make a sine out of what is none."""
    runs = each_axis(n=4000)
    runs = [replace(r, reference=r.reference + 10.0 * np.sin(2 * pi * 4.7 * r.time_s)) for r in runs]
    assert any("not a sine" in reason or "no sine" in reason for reason in method1.solve(runs).reasons)
