"""One solution from records and statements: against the adjustment of files, under walks and steps, and thinned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.adjustment.adjustment import adjust
from calib.estimate.estimate import estimate
from calib.estimate.nuisances import Priors
from calib.estimate.rows import NoiseScores
from calib.estimate.statements import Statements, Step
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Array
from calib.state.state import State
from calib.state.thinning import NEWEST, thinned
from calib.windows.condense import condense
from calib.windows.excited import excited
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.clamp_windows import ALPHAS_DEG, S_TRUE, TRUTH, Faults, clamp_points

MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.where(np.eye(3).ravel() > 0, 0.05, 0.03), np.full(3, 20.0))
STILL = Wander(dict.fromkeys(Wander.none().values, 0.0))
DEGREE = np.deg2rad(1.0)


def walking(**walks: float) -> Wander:
    return Wander(dict(STILL.values) | walks)


def u_of(covariance: Array) -> Array:
    return np.sqrt(np.diag(covariance))


@pytest.mark.slow
@pytest.mark.parametrize("repetitions", [3, 12])
def test_without_walks_it_is_the_adjustment_of_all_windows(repetitions: int) -> None:
    random = np.random.default_rng(3)
    alphas = {alpha: 0.2 * DEGREE * random.normal() for alpha in ALPHAS_DEG}
    faults = Faults(theta_rad=0.2 * DEGREE * random.normal(), alpha_rad=alphas, offset_mps2=0.05)
    windows = clamp_points(random, faults, repetitions=repetitions).windows
    priors = Priors(lag_window_s=0.0)
    at_once = adjust(windows, Priors(priors.values, MEAN, np.diag(U**2)))
    records = [Record.of(window, k * 1e-3) for k, window in enumerate(windows)]
    found = estimate(records, Statements(MEAN, U, {"": priors}, STILL, TemperatureModel())).now
    u = u_of(at_once.covariance)[:12]
    np.testing.assert_array_less(np.abs(found.mean[:12] - at_once.mean[:12]) / u, 0.03)
    np.testing.assert_allclose(np.sqrt(found.variance[:12]), u, rtol=0.02)


def test_appended_window_by_window_it_is_the_solution_of_all() -> None:
    random = np.random.default_rng(4)
    wander = walking(sensitivity=2e-4, offset_mps2=0.01)
    state = State(MEAN, U, Priors(), wander, TemperatureModel(), fixed=False)
    for k in range(30):
        state.update(Record.of(building_window(random, level_mps2=(0.1, 0.1, 0.1)), 0.02 * k))
    appended = state.result()
    whole = state.estimate()
    u = appended.standard_uncertainty
    away = np.append(appended.sensitivity, appended.offset) - whole.now.mean[:12]
    np.testing.assert_array_less(np.abs(away) / u, 0.05)
    np.testing.assert_allclose(np.sqrt(whole.now.variance[:12]), u, rtol=0.02)


def test_the_past_knows_what_came_later() -> None:
    """A step of S_yy by 3 % that is stated, and windows on both sides of a gap: S in the gap is between its ends."""
    random, S = np.random.default_rng(5), S_TRUE.copy()
    S[1, 1] *= 1.03
    windows = [building_window(random, level_mps2=(0.1, 0.1, 0.1)) for _ in range(6)]
    windows += [building_window(random, level_mps2=(0.1, 0.1, 0.1), S=S) for _ in range(6)]
    records = [Record.of(window, 10.0 * k) for k, window in enumerate(windows)]
    step = Step(55.0, {"Syy": 0.1})
    stated = Statements(MEAN, U, {"": Priors()}, walking(sensitivity=1e-5), TemperatureModel(), steps=(step,))
    found = estimate(records, stated)
    past = list(found.past())[::-1]
    values, variances = np.array([then.now.mean for then in past]), np.array([then.now.variance for then in past])
    assert [then.now.day for then in past] == [10.0 * k for k in range(12)]
    moved = values[6:, 4].mean() - values[:6, 4].mean()
    assert moved == pytest.approx(S[1, 1] - S_TRUE[1, 1], abs=1e-3)
    first = estimate(records[:1], stated).now
    assert np.sqrt(variances[0, 4]) < 0.8 * np.sqrt(first.variance[4])  # five more windows of the same S
    np.testing.assert_array_equal(values[-1], found.now.mean)
    assert past[5].moved[4] == pytest.approx(values[6, 4] - values[5, 4], rel=1e-6)


def test_a_year_without_windows_after_an_adopted_step_does_not_pull_s_back() -> None:
    """The walk is so lively that its bound, the prior, is reached within months. Without a centre that moves with the
    step, S would be half way back to the certificate."""
    random, S = np.random.default_rng(6), S_TRUE.copy()
    S[1, 1] *= 1.10
    u = np.append(np.full(9, 0.01), np.full(3, 20.0))
    wander = walking(sensitivity=1e-3)
    state = State(np.append(S_TRUE.ravel(), np.zeros(3)), u, Priors(), wander, TemperatureModel(), fixed=False)
    for k in range(4):
        state.update(Record.of(building_window(random, level_mps2=(0.1, 0.1, 0.1)), 0.02 * k))
    state.step({"Syy": 0.1})
    for k in range(4, 10):
        state.update(Record.of(building_window(random, level_mps2=(0.1, 0.1, 0.1), S=S), 0.02 * k))
    adopted, later = state.result().sensitivity[1, 1], state.law(400.0).at(20.0)
    assert adopted == pytest.approx(S[1, 1], abs=3e-3)
    assert later.sensitivity[1, 1] == pytest.approx(adopted, abs=1e-3)
    assert later.standard_uncertainty[4] == pytest.approx(0.01, rel=0.2)  # that of a sensor of which nothing was seen


def many(random: np.random.Generator, number: int, cadence: float, **more: object) -> list[Record]:
    level = (0.1, 0.1, 0.1)
    made = (building_window(random, level_mps2=level, **more) for _ in range(number))  # type: ignore[arg-type]
    return [Record.of(window, k * cadence, 0.0, 20.0 + 3.0 * np.sin(k), "A") for k, window in enumerate(made)]


@pytest.mark.slow
def test_thinned_records_say_the_same() -> None:
    records = many(np.random.default_rng(7), 180, 0.25)
    wander = walking(sensitivity=2e-5, offset_mps2=1e-3)
    stated = Statements(MEAN, U, {"": Priors()}, wander, TemperatureModel(1))
    few = thinned(records, records[-1].day, np.eye(3))
    assert len(few) < 0.7 * len(records)
    assert sum(record.windows for record in few) == len(records)
    whole, now = estimate(records, stated).now, estimate(few, stated).now
    u = np.sqrt(whole.variance[:12])
    np.testing.assert_array_less(np.abs(now.mean[:12] - whole.mean[:12]) / u, 0.1)
    np.testing.assert_allclose(np.sqrt(now.variance[:12]), u, rtol=0.01)


@pytest.mark.slow
def test_nothing_is_merged_across_a_step() -> None:
    records = many(np.random.default_rng(8), NEWEST + 40, 0.01)
    cut = records[20].day
    few = thinned(records, records[-1].day + 100.0, np.eye(3), cuts=[cut])
    assert all(record.days[1] < cut or record.days[0] >= cut for record in few)
    assert any(record.windows > 1 for record in few)


@pytest.mark.slow
def test_windows_are_brought_to_one_lag_before_they_are_merged() -> None:
    """From half of the windows 0.2 ms more were taken out than from the others."""
    early = [replace(r, temperature_degc=20.0) for r in many(np.random.default_rng(9), 40, 0.0005)]
    after = [replace(r, day=r.day + 1.0) for r in many(np.random.default_rng(1), NEWEST, 1.0)]
    late = [replace(r, slopes=_at_lag(r, 2e-4), lag_s=2e-4) for r in early[::2]]
    records = sorted([*late, *early[1::2]], key=lambda r: r.day)
    (alone,), (mixed,) = (
        [r for r in thinned(own + after, 61.0, np.eye(3)) if r.windows > 1] for own in (early, records)
    )
    assert alone.windows == mixed.windows == len(early)
    size = np.abs(alone.slopes).max()
    np.testing.assert_allclose(_at_lag(mixed, alone.lag_s) / size, alone.slopes / size, rtol=0, atol=2e-4)


def _at_lag(record: Record, lag_s: float) -> np.ndarray:
    """The slopes as if this lag had been taken out, of first order."""
    return np.asarray(record.slopes - (lag_s - record.lag_s) * record.loadings[0].reshape(-1, 3) * record.noise)


@pytest.mark.slow
def test_a_direction_that_nothing_excites_learns_nothing_at_a_mount_that_never_turns() -> None:
    """Motion along y with a noisy reference: 120 windows, and S_xx stays as uncertain, and where, it was."""
    random = np.random.default_rng(10)
    state = State(MEAN, U, Priors(offset_mps2=0.002), STILL, TemperatureModel(), fixed=True)
    for k in range(120):
        window = building_window(random, reference_noise_mps2=1e-3)
        noisy = replace(window, reference_noise=np.array([[1e-3] * 3, [0.0] * 3]))
        state.update(Record.of(noisy, k / 24.0))
    now = state.result()
    np.testing.assert_allclose(now.standard_uncertainty[[0, 8]], U[[0, 8]], rtol=1e-6)
    np.testing.assert_allclose(now.sensitivity[[0, 2], [0, 2]], 1.0, rtol=0, atol=1e-9)
    assert abs(now.sensitivity[1, 1] - TRUTH[4]) < 4.0 * now.standard_uncertainty[4] < 0.01


def test_noise_that_correlates_is_pooled_over_windows_as_sums() -> None:
    """AR(1) noise of 0.9 makes the variance of a mean (1 + 0.9) / (1 - 0.9) = 19 times that of white noise. One window
    of 12 segments cannot tell how neighbours correlate: ratios of single windows gave 8.9, and 0.70 of u of S_zx."""
    random = np.random.default_rng(5)
    windows = clamp_points(random, Faults(0.003, 0.001, {}, 0.02, 4e-4, 0.02, 0.9), repetitions=12).windows
    noise = NoiseScores.around([Record.of(window, 0.0) for window in windows])[-1]
    # By 70 degrees of freedom a variance is known to 17 %. They are a third of the segments, joined in pairs.
    assert noise.means == pytest.approx(19.0, rel=0.3)
    assert 50.0 < noise.degrees_of_freedom < 100.0
    at_once = condense([excited(window) for window in windows]).type_a
    assert noise.slopes == pytest.approx(at_once.slope_ratio(np.ones(6, dtype=bool)), rel=0.07)
    assert noise.means == pytest.approx(float(np.diag(at_once.means).mean()), rel=0.07)


def test_noise_is_pooled_over_windows_nearby() -> None:
    """Noise is white at first, and AR(1) of 0.9 later. Pooled over all windows, the variance of the means would be 10
    in both: u of the new windows would be 0.7 of what it is, and that of the old ones 3 times."""
    random, records = np.random.default_rng(6), list[Record]()
    for phi in (0.0, 0.9):
        made = clamp_points(random, Faults(phi=phi), repetitions=12).windows
        records += [Record.of(window, 0.0) for window in made] * 20
    noise = [own.means for own in NoiseScores.around(records)]
    assert noise[0] == pytest.approx(1.0, rel=0.3)  # by 160 degrees of freedom
    assert noise[-1] == pytest.approx(19.0, rel=0.3)
    assert noise[len(noise) // 2] == pytest.approx(10.0, rel=0.3)
