"""The state against other ways to the same numbers, and what it must never do however long it runs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from agent.core.snapshot import pack
from calib.adjustment.adjustment import adjust
from calib.distributions import chi2_quantile
from calib.estimate.nuisances import Priors
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Array, Calibration
from calib.state.state import State
from calib.windows.record import Record
from tests.building_windows import BESIDE, GRAVITY, building_window
from tests.clamp_windows import ALPHAS_DEG, G_MPS2, Q_TRUE, S_TRUE, TRUTH, Faults, clamp_points, sums_of

MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.where(np.eye(3).ravel() > 0, 0.05, 0.03), np.full(3, 20.0))
STILL = Wander({**Wander.none().values, "offset_rate_mps2": 1e-9})
DEGREE = np.deg2rad(1.0)
COLUMN_Y, OTHERS = [1, 4, 7], [0, 2, 3, 5, 6, 8]
FIXED = Priors(gravity_mps2=0.03, offset_mps2=1e-3, lag_window_s=0.0)


def turned(priors: Priors, wander: Wander = STILL) -> State:
    return State(MEAN, U, priors, wander, TemperatureModel(), fixed=False)


def mounted(priors: Priors = FIXED, wander: Wander = STILL, model: TemperatureModel | None = None) -> State:
    return State(MEAN, U, priors, wander, model or TemperatureModel(), fixed=True)


def values(calibration: Calibration) -> np.ndarray:
    return np.append(calibration.sensitivity.ravel(), calibration.offset)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_on_a_clamp_it_gives_what_all_windows_at_once_give(seed: int) -> None:
    random = np.random.default_rng(seed)
    faults = Faults(
        theta_rad=0.2 * DEGREE * random.normal(),
        alpha_rad={alpha: 0.2 * DEGREE * random.normal() for alpha in ALPHAS_DEG},
        offset_mps2=0.05,
        lag_s=2e-4,
    )
    windows = clamp_points(random, faults).windows
    found = turned(Priors())
    for k, window in enumerate(windows):
        found.update(Record.of(window, k * 1e-3))
    priors = Priors(parameters=MEAN, covariance=np.diag(U**2)).at_one_frequency(found.reference_frequency_hz, 0.0)
    at_once = adjust(windows, priors)
    u = np.sqrt(np.diag(at_once.covariance)[:12])
    # Both weigh each window by its own noise; what differs is which windows that noise was learned from.
    np.testing.assert_array_less(np.abs(values(found.result()) - at_once.mean[:12]) / u, 0.2)
    ratio = found.result().standard_uncertainty / u
    np.testing.assert_allclose(np.delete(ratio, [6, 7]), 1.0, atol=0.02)
    # S_zx and S_zy are all type A, which twelve windows of six segments tell to 13 %.
    np.testing.assert_allclose(ratio[[6, 7]], 1.0, atol=0.2)


def test_with_exact_angles_it_is_the_least_squares_of_all_points() -> None:
    points = clamp_points(np.random.default_rng(5), Faults(noise_mps2=0.02), repetitions=2)
    found = turned(Priors.none().with_values({"offset_mps2": 1e-9}))
    for k, window in enumerate(points.windows):
        found.update(Record.of(window, k * 1e-3))
    basis = np.column_stack([points.a, np.ones(len(points.a))])
    plain, *_ = np.linalg.lstsq(basis, points.V, rcond=None)
    # Type A is 8e-5; windows are weighed by their own noise, known to 5 %, here and not there.
    np.testing.assert_allclose(found.result().sensitivity, plain[:3].T, rtol=0, atol=5e-5)
    np.testing.assert_allclose(found.result().offset, plain[3], rtol=0, atol=5e-4)


@cache
def error_over_u(seed: int) -> Array:
    """Error of each parameter (12,) of a drawn session over U / 2."""
    random = np.random.default_rng(1000 + seed)
    faults = Faults(
        theta_rad=0.2 * DEGREE * random.normal(),
        alpha_common_rad=0.1 * DEGREE * random.normal(),
        alpha_rad={alpha: 0.2 * DEGREE * random.normal() for alpha in ALPHAS_DEG},
        offset_mps2=0.05,
    )
    S = np.eye(3) * (1 + 0.05 * random.normal(size=3)) + 0.03 * random.normal(size=(3, 3)) * (1 - np.eye(3))
    found = turned(Priors().with_values({"gravity_mps2": 0.0, "reference": 0.0, "transverse": 0.0}))
    for k, window in enumerate(clamp_points(random, faults, S=S, rate_hz=60.0).windows):
        found.update(Record.of(window, k * 1e-3))
    calibration = found.result()
    away = values(calibration) - np.append(S.ravel(), Q_TRUE)
    return np.asarray(2.0 * away / (found.coverage_factor * calibration.standard_uncertainty))


@pytest.mark.slow
@pytest.mark.parametrize("runs", [16, pytest.param(80, marks=pytest.mark.nightly)])
def test_the_stated_uncertainty_covers(runs: int) -> None:
    squares = np.sum([error_over_u(seed) ** 2 for seed in range(runs)], axis=0)
    # Chi-squared with `runs` degrees of freedom; the bounds of all twelve hold jointly at 99.9 %.
    low, high = (chi2_quantile(p, runs) for p in (0.001 / 24, 1 - 0.001 / 24))
    assert np.all((low < squares) & (squares < high)), squares
    # All twelve together, at 95 % of 16 runs; here 0.93 (80 runs: 0.89). A variance 1.5 times as large or small fails.
    assert 0.81 < squares.sum() / 12 / runs < 1.21


@pytest.mark.slow
def test_what_was_not_excited_stays_to_the_last_digit() -> None:
    random, found = np.random.default_rng(1), mounted()
    for k in range(16):
        found.update(Record.of(building_window(random), k / 24))
    S = found.result().sensitivity.ravel()
    np.testing.assert_allclose(S[OTHERS], MEAN[OTHERS], rtol=0, atol=1e-12)
    np.testing.assert_allclose(S[COLUMN_Y], S_TRUE.ravel()[COLUMN_Y], rtol=0, atol=3e-3)
    np.testing.assert_array_equal(np.flatnonzero(found.result().determined[:9]), COLUMN_Y)
    np.testing.assert_allclose(found.result().standard_uncertainty[OTHERS], U[OTHERS], rtol=1e-9)


def test_windows_along_nearly_one_direction_excite_no_other() -> None:
    """0.01 rad to both sides of it: across, they moved 1e-4 times as much, and less than 1e-3 counts as nothing."""
    random, found = np.random.default_rng(1), mounted()
    for k in range(6):
        way = np.array([0.01 * (-1) ** k, 1.0, 0.0])
        record = Record.of(building_window(random), k / 24)
        found.update(replace(record, excited=np.outer(way, way) / (way @ way)))
    assert found.unexcited.shape == (2, 3)
    np.testing.assert_allclose(found.unexcited[:, 1], 0.0, atol=1e-3)


def test_motion_that_goes_along_is_none_of_the_excited_column() -> None:
    # x moves along with y at 0.9 % of it, too little to tell S_x by, enough to put 1 % into S_xy if it were left out.
    random, found = np.random.default_rng(2), mounted()
    for k in range(20):
        window = building_window(random)
        sums = window.sums
        turn = np.eye(9)
        turn[0, 1] = turn[3, 4] = 0.009  # u_x = 0.009 u_y, and so its derivative
        felt = np.eye(9)
        felt[6:, 1] = 0.009 * S_TRUE[:, 0]  # and the sensor feels it
        both = felt @ turn
        moved = replace(sums, mean=sums.mean @ both.T, scatter=np.einsum("ab,kbc,dc->kad", both, sums.scatter, both))
        found.update(Record.of(replace(window, sums=moved), k / 24))
    assert abs(found.result().sensitivity[0, 1] - S_TRUE[0, 1]) < 1.5e-3
    np.testing.assert_allclose(found.result().sensitivity[:, 0], MEAN[[0, 3, 6]], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_mean_that_drifts_at_a_fixed_mount_moves_the_offset_alone() -> None:
    wander = Wander(
        {**Wander.none().values, "offset_mps2": 0.01, "offset_rate_mps2": 1e-3, "offset_rate_walk_mps2": 1e-5}
    )
    random, found = np.random.default_rng(3), mounted(wander=wander)
    for k in range(80):
        Q = Q_TRUE + 0.24 * k / 79
        found.update(Record.of(building_window(random, Q=Q), k / 24))
    now = found.result()
    np.testing.assert_allclose(now.sensitivity.ravel()[OTHERS], MEAN[OTHERS], rtol=0, atol=1e-12)
    output = S_TRUE @ GRAVITY + Q_TRUE + 0.24
    np.testing.assert_allclose(now.sensitivity @ GRAVITY + now.offset, output, rtol=0, atol=2e-3)
    # What of the mean is Q and what S_iz g nobody told: U(Q) must say so.
    assert np.all(np.abs(now.offset - Q_TRUE - 0.24) < 2.0 * now.standard_uncertainty[9:])
    assert now.standard_uncertainty[9] > 0.9 * U[2] * G_MPS2


@pytest.mark.slow
@pytest.mark.parametrize("windows", [60, pytest.param(250, marks=pytest.mark.nightly)])
def test_a_reference_known_to_a_tenth_of_a_per_cent_is_never_known_better(windows: int) -> None:
    random, found = np.random.default_rng(4), mounted(FIXED.with_values({"reference": 1e-3}))
    smallest = np.inf
    for k in range(windows):
        found.update(Record.of(building_window(random, reference_error=1.5e-3), k / 24))
        smallest = min(smallest, float(found.result().standard_uncertainty[4]))
    # S_yy is known relative to a prior of 5 %, which takes 0.02 % off the reference's own 0.1 %.
    assert smallest > 0.97e-3
    assert abs(found.result().sensitivity[1, 1] - S_TRUE[1, 1]) < 2 * 1.1e-3


@pytest.mark.thorough
def test_nor_by_motion_askew_to_its_channels() -> None:
    """Which way it goes was measured by two channels, each with its own error: their ratio is no third standard."""
    random, found = np.random.default_rng(12), mounted(FIXED.with_values({"reference": 1e-3}))
    off = np.array([1.5e-3, -1.0e-3, 0.5e-3])
    for k in range(150):
        way = random.normal(size=3)
        window = building_window(random, direction=way / np.linalg.norm(way), reference_error=off)
        found.update(Record.of(window, k / 24))
    u = found.result().standard_uncertainty
    assert u[[0, 4, 8]].min() > 0.97e-3
    np.testing.assert_allclose(found.result().sensitivity @ np.diag(1.0 + off), S_TRUE, rtol=0, atol=1e-3)


def test_wandering_never_makes_less_known_than_before_any_data() -> None:
    walks: dict[str, Any] = {
        "sensitivity": 0.01,
        "offset_mps2": 0.1,
        "offset_rate_mps2": 1e-3,
        "offset_rate_walk_mps2": 1e-3,
    }
    random, found = (
        np.random.default_rng(5),
        mounted(wander=Wander({**Wander.none().values, **walks, "tilt_rad": 0.01})),
    )
    found.update(Record.of(building_window(random), 0.0))
    found.update(Record.of(building_window(random), 1e6))
    u = found.result().standard_uncertainty
    assert np.all(u[OTHERS] <= U[OTHERS] * (1 + 1e-9))
    assert u[4] < U[4]


@pytest.mark.slow
def test_temperature_is_told_from_drift() -> None:
    random = np.random.default_rng(6)
    model = TemperatureModel(offset_order=1, sensitivity_order=1, u_offset_mps2=(0.05, 1e-3), u_sensitivity=1e-3)
    found = mounted(model=model, wander=Wander({**Wander.none().values, "offset_mps2": 1e-3, "offset_rate_mps2": 1e-3}))
    per_k, of_S = np.array([0.01, -0.02, 0.005]), np.array([[0.0, 0.0, 2e-4], [3e-4, 5e-4, 0.0], [0.0, 0.0, -4e-4]])
    for k in range(72):
        day = k / 24
        above = 8.0 * np.sin(2 * np.pi * day)
        S = S_TRUE + of_S * above
        Q = Q_TRUE + per_k * above + 0.003 * day
        found.update(Record.of(building_window(random, S=S, Q=Q, level_mps2=(0.3, 0.3, 0.3)), day, 0.0, 20.0 + above))
    for i, axis in enumerate("xyz"):  # under gravity S moves the mean as well, which is no change of Q
        value, u = found.quantity(f"Q{axis}_T1")
        assert abs(value - per_k[i]) < 4 * u
        assert u < 1e-3
        for j, way in enumerate("xyz"):
            value, u = found.quantity(f"S{axis}{way}_T1")
            assert abs(value - of_S[i, j]) < 4 * u
            assert u < 5e-5
    at_30 = found.law().at(30.0)
    np.testing.assert_allclose(at_30.sensitivity, S_TRUE + 10.0 * of_S, rtol=0, atol=1.5e-3)
    np.testing.assert_allclose(
        at_30.sensitivity @ GRAVITY + at_30.offset,
        (S_TRUE + 10.0 * of_S) @ GRAVITY + Q_TRUE + 10.0 * per_k + 0.003 * day,
        rtol=0,
        atol=5e-3,
    )
    low, high = found.temperature_range_degc
    assert (low, high) == pytest.approx((12.0, 28.0), abs=0.2)


@pytest.mark.slow
def test_a_window_without_a_temperature_may_have_had_any_of_those_before() -> None:
    random, found = np.random.default_rng(14), mounted(model=TemperatureModel(1, u_offset_mps2=(0.05, 0.0)))
    per_k = np.array([0.01, -0.03, 0.02])
    for k in range(48):
        above = 10.0 * np.sin(2 * np.pi * k / 24)
        found.update(Record.of(building_window(random, Q=Q_TRUE + per_k * above), k / 24, 0.0, 20.0 + above))
    output = found.result().sensitivity @ GRAVITY + found.result().offset
    for k in range(48, 52):
        window = building_window(random, Q=Q_TRUE + per_k * 8.0)
        told = found.innovation(Record.of(window, k / 24))
        assert told.statistic < 45  # 12 degrees of freedom: one in 10^5
        found.update(Record.of(window, k / 24))
    moved = found.result().sensitivity @ GRAVITY + found.result().offset - output
    np.testing.assert_allclose(moved, 0.0, atol=2e-3)  # 80 to 240 mm/s2 would be taking 28 degC for 20


@pytest.mark.slow
def test_the_innovation_is_chi_squared_and_each_score_normal() -> None:
    scores, statistics, freedom = [], [], 0
    for seed in range(20):
        random = np.random.default_rng(seed)
        found = mounted(FIXED.with_values({"offset_mps2": 1e-3}))
        Q = Q_TRUE + 1e-3 * random.normal(size=(12, 3))
        for k in range(12):
            record = Record.of(building_window(random, level_mps2=(0.1, 0.1, 0.1), Q=Q[k]), k / 24)
            if k >= 3:
                told = found.innovation(record)
                statistics.append(told.statistic)
                scores.append(told.score)
                freedom = told.degrees_of_freedom
            found.update(record)
    n = len(statistics)
    assert freedom == 21
    # 180 of them: the mean's SD is 0.48; segments of one window know their own scatter to a few per cent.
    assert 0.9 * freedom < np.mean(statistics) < 1.12 * freedom
    assert np.all(np.abs(np.mean(scores, axis=0)) < 4 / np.sqrt(n))
    np.testing.assert_allclose(np.std(scores, axis=0), 1.0, atol=0.17)  # a variance of 1.5 is seen


@pytest.mark.slow
def test_a_change_moves_a_score_by_what_the_information_says() -> None:
    random, found = np.random.default_rng(8), mounted()
    for k in range(10):
        found.update(Record.of(building_window(random), k / 24))
    S = S_TRUE.copy()
    S[1, 1] += 0.01
    told = [found.innovation(Record.of(building_window(random, S=S), 10 / 24)) for _ in range(30)]
    expected = 0.01 * np.sqrt(told[0].information[4])
    assert expected > 5
    assert np.mean([t.score[4] for t in told]) == pytest.approx(expected, abs=4 * 1.2 / np.sqrt(30) + 0.05 * expected)
    assert np.isnan(told[0].score[[0, 2]]).all()  # these columns were not excited


@pytest.mark.slow
def test_a_snapshot_goes_on_bit_for_bit() -> None:
    random = np.random.default_rng(9)
    records = [Record.of(building_window(random), k / 24, 1e-4, 20.0 + k) for k in range(8)]
    records += [Record.of(w, 1.0 + k) for k, w in enumerate(clamp_points(random).windows)]
    going_on, other = turned(Priors()), turned(Priors())
    for record in records:
        fresh = turned(Priors())
        fresh.load(other.snapshot())
        other = fresh
        again = Record.load(record.snapshot())
        assert other.innovation(again).statistic == going_on.innovation(record).statistic
        going_on.update(record)
        other.update(again)
    np.testing.assert_array_equal(values(other.result()), values(going_on.result()))
    np.testing.assert_array_equal(other.result().covariance, going_on.result().covariance)


@pytest.mark.slow
def test_an_operators_calibration_is_where_it_goes_on_from() -> None:
    random, found = np.random.default_rng(10), mounted()
    for k in range(5):
        found.update(Record.of(building_window(random), k / 24))
    earlier = found.result()
    S = S_TRUE * 1.02
    for k in range(5, 10):
        found.update(Record.of(building_window(random, S=S), k / 24))
    found.put(earlier)
    np.testing.assert_allclose(values(found.result()), values(earlier), rtol=0, atol=1e-10)
    # Its covariance with the nuisances is lost: covariance intersection doubles it.
    np.testing.assert_allclose(found.result().covariance, 2.0 * earlier.covariance, rtol=1e-7, atol=1e-11)
    found.update(Record.of(building_window(random), 1.0))
    assert abs(found.result().sensitivity[1, 1] - S_TRUE[1, 1]) < 3e-3


@pytest.mark.thorough
def test_accepted_again_and_again_it_is_known_no_better() -> None:
    # The reference's 0.1 % is in S: were it met as a new one after each accept, u(S_yy) were 0.03 % after six.
    random, found = np.random.default_rng(12), mounted(FIXED.with_values({"reference": 1e-3}))
    for turn in range(6):
        for k in range(12):
            found.update(Record.of(building_window(random, reference_error=1.5e-3), turn + k / 24))
        found.put(found.result())
    assert found.result().standard_uncertainty[4] > 0.97e-3


def test_asking_what_a_first_window_says_changes_nothing() -> None:
    random, found = np.random.default_rng(13), mounted()
    before = pack(found.snapshot())
    found.innovation(Record.of(building_window(random), 0.0))
    assert pack(found.snapshot()) == before


@pytest.mark.slow
def test_a_certificate_of_q_does_not_hide_how_the_mount_leans() -> None:
    # Q known to 1 mm/s2, the mount to 0.2 deg: under gravity that is 34 mm/s2 of mean output nobody stated.
    u = np.append(U[:9] / 1000.0, np.full(3, 1e-3))
    scores = []
    for seed in range(20):
        random = np.random.default_rng(seed)
        found = State(TRUTH, u, FIXED.with_values({"angle_rad": 0.2 * DEGREE}), STILL, TemperatureModel(), fixed=True)
        leaning = GRAVITY + np.cross(0.2 * DEGREE * random.normal(size=3), GRAVITY)
        found.update(Record.of(building_window(random, gravity_mps2=leaning), 0.0))
        now = found.result()
        np.testing.assert_allclose(now.standard_uncertainty[9:11], 0.2 * DEGREE * G_MPS2, rtol=0.05)
        scores += ((now.offset - Q_TRUE) / now.standard_uncertainty[9:])[:2].tolist()
    # 40 of variance 1: three SD of their mean square are 0.67.
    assert 0.33 < np.mean(np.square(scores)) < 1.67


def test_a_window_of_another_pose_than_stated_is_far_from_expected() -> None:
    random, found = np.random.default_rng(11), mounted()
    for k in range(5):
        found.update(Record.of(building_window(random), k / 24))
    tilted = GRAVITY + np.array([0.5, 0.0, 0.0])
    calm = found.innovation(Record.of(building_window(random), 0.3))
    turned_ = found.innovation(Record.of(building_window(random, gravity_mps2=tilted), 0.3))
    assert calm.statistic < 45  # 12 degrees of freedom: one in 10^5
    assert turned_.statistic > 1000


def test_truth_is_what_the_tests_take_it_for() -> None:
    assert np.array_equal(TRUTH, np.append(S_TRUE.ravel(), Q_TRUE))
    assert BESIDE.direction.shape == (3, 3)
    assert sums_of(np.zeros((4, 3)), np.zeros((4, 3)), np.ones((4, 3)), 2).count.tolist() == [2.0, 2.0]


def test_the_law_of_a_later_day_has_wandered_on_and_changes_nothing() -> None:
    found = turned(
        Priors(), Wander({**Wander.none().values, "sensitivity": 0.001, "offset_mps2": 0.01, "offset_rate_mps2": 0.004})
    )
    for k, window in enumerate(clamp_points(np.random.default_rng(3)).windows):
        found.update(Record.of(window, k * 1e-3))
    before = found.snapshot()
    now, later = found.law().at(20.0), found.law(100.0).at(20.0)
    grown = later.standard_uncertainty[9:] ** 2 - now.standard_uncertainty[9:] ** 2
    # 0.01 per square-root day and a rate known to 0.004 a day at first, over 100 days.
    rate_u = np.array([found.quantity(name)[1] for name in ("Qx_rate", "Qy_rate", "Qz_rate")])
    np.testing.assert_allclose(grown, 100.0 * 0.01**2 + (100.0 * rate_u) ** 2, rtol=0.02)
    assert repr(found.snapshot()) == repr(before)


def test_a_rate_of_the_offset_that_is_stated_to_begin_at_zero_still_walks() -> None:
    """Its bound is no division by zero: the walk alone makes the rate uncertain, by 2e-5 a root day."""
    state = mounted(wander=Wander(offset_rate_mps2=0.0))
    for day in (0.0, 16.0):
        state.update(Record.of(building_window(np.random.default_rng(1)), day))
    assert state.quantity("Qz_rate")[1] == pytest.approx(2e-5 * 4.0, rel=0.01)
