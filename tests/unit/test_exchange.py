"""A prior in a joint state is exchanged for another: against the state that had the other prior from the beginning."""

from __future__ import annotations

import numpy as np
import pytest

from calib.estimate.joint_state import JointState, gain_of
from calib.estimate.nuisances import Priors
from calib.estimate.quantities import LEAN, REFERENCE, SENSITIVITY, Quantity
from calib.estimate.recursion import Recursion
from calib.estimate.wander import TemperatureModel, Wander
from calib.estimate.window_rows import Summary
from tests.building_windows import building_window
from tests.clamp_windows import Q_TRUE, S_TRUE

HOUR = 1.0 / 24.0
STEADY = dict.fromkeys(Wander.none().values, 0.0)
STATED = {"reference": 3e-3, "rotation_rad": 3e-3, "gravity_mps2": 0.03, "lag_s": 0.005, "offset_mps2": 0.02}
MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.where(np.eye(3).ravel() > 0, 0.05, 0.03), np.full(3, 1.0))


def joint(u: tuple[float, ...], means: tuple[float, ...] = (1.0, 0.0)) -> JointState:
    """A sensitivity and the error of its reference."""
    quantities = [Quantity("Sxx", SENSITIVITY), Quantity("reference", REFERENCE, owner="A")]
    return JointState(quantities, np.array(means), np.array(u))


def seen(state: JointState, value: float, rows: np.ndarray) -> None:
    gain = gain_of(rows, state.factor)
    state.correct(gain @ (value - rows @ state.mean), gain, rows)


@pytest.mark.parametrize(("mean", "u"), [(0.0, 0.006), (0.0, 0.001), (0.004, 0.003), (-0.01, 0.02), (0.002, 0.0)])
def test_exchanged_it_is_as_if_it_had_been_stated_so_from_the_beginning(mean: float, u: float) -> None:
    rows = np.array([[1.0, -1.0], [0.3, 1.0]]) / 1e-3
    found, expected = joint((0.05, 0.003)), joint((0.05, u), (1.0, mean))
    for state in (found, expected):
        seen(state, 1002.0, rows[:1])
        seen(state, 301.0, rows[1:])
    found.exchange(1, mean, u)
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-8, atol=1e-16)


@pytest.mark.parametrize("u", [0.001, 0.002, 0.008])
def test_of_a_quantity_that_walked_the_first_value_is_exchanged(u: float) -> None:
    # Nothing was seen: the value is its first one, with the prior of now, and the walk.
    state = JointState([Quantity("lean_x[p]", LEAN, "p")], np.zeros(1), np.array([0.003]))
    state.spread(np.array([0.002**2]))
    state.exchange(0, 0.0, u)
    assert state.covariance[0, 0] == pytest.approx(u**2 + 0.002**2, rel=1e-12)


def test_what_was_exact_cannot_become_uncertain() -> None:
    with pytest.raises(ValueError, match="reference of A had no uncertainty"):
        joint((0.05, 0.0)).exchange(1, 0.0, 0.001)


def fresh(stated: dict[str, float], temperature: TemperatureModel | None = None, mean: np.ndarray = MEAN) -> Recursion:
    priors = Priors(dict(Priors.none().values) | stated)
    return Recursion(mean, U, priors, Wander(STEADY), temperature or TemperatureModel(), fixed=False)


def lived(windows: int = 6, error: float = 0.0, **recursion: object) -> Recursion:
    """A recursion after windows of an hour each, the temperature between 15 and 25 deg C."""
    random, found = np.random.default_rng(1), fresh(STATED, **recursion)  # type: ignore[arg-type]
    found.meet("A")
    for k in range(windows):
        window = building_window(random, level_mps2=(0.1, 0.1, 0.1), reference_error=error)
        found.update(Summary.of(window, k * HOUR, 0.0, 15.0 + 2.0 * (k % 6), "A"))
    return found


def u_of(found: Recursion) -> np.ndarray:
    return found.result().standard_uncertainty


def restarted(before: Recursion, now: Recursion, **certificate: object) -> Recursion:
    now.load(before.snapshot())
    now.restate()
    now.meet("A", **certificate)  # type: ignore[arg-type]
    return now


def test_another_order_of_the_temperature_begins_again_with_the_kept_windows_and_loses_nothing() -> None:
    order = TemperatureModel(offset_order=1)
    found = restarted(lived(), fresh(STATED, order))
    exact = lived(temperature=order)
    # The windows are weighed by the noise of all windows now; at first each was weighed by those before it.
    np.testing.assert_allclose(u_of(found), u_of(exact), rtol=5e-3)
    np.testing.assert_allclose(found.result().sensitivity, exact.result().sensitivity, rtol=0, atol=2e-5)
    back = restarted(found, fresh(STATED))
    assert "Qx_T1" not in back.names
    np.testing.assert_allclose(u_of(back), u_of(lived()), rtol=5e-3)


def test_a_quantity_that_was_exact_before_comes_in_with_the_kept_windows() -> None:
    stated = STATED | {"offset_position_mps2": 0.05}
    found = restarted(lived(), fresh(stated))
    assert found.quantity("offset_x[beside]")[1] > 0.0
    assert found.result().standard_uncertainty[9] > 0.99 * np.hypot(0.05, lived().result().standard_uncertainty[9])
    assert found.windows == 6


def test_a_prior_of_the_sensor_is_exchanged_too() -> None:
    other = MEAN + np.append(np.full(9, 0.004), np.zeros(3))
    found = restarted(lived(), fresh(STATED, mean=other))
    expected = lived(mean=other)
    np.testing.assert_allclose(found.result().sensitivity, expected.result().sensitivity, rtol=0, atol=2e-5)


def test_a_local_gravity_that_is_stated_better_moves_q_as_if_it_had_been_known() -> None:
    now = fresh(STATED | {"gravity_mps2": 1e-3})
    now.load(lived().snapshot())
    now.restate((9.80665, 9.83))
    Q = now.result().offset
    expected = Q_TRUE + S_TRUE[:, 2] * (9.80665 - 9.83)  # the windows were made under 9.80665
    np.testing.assert_allclose(Q, expected, rtol=0, atol=5.0 * now.result().standard_uncertainty[9:].max())
    assert np.abs(Q - Q_TRUE).max() > 0.015
    window = building_window(np.random.default_rng(2), level_mps2=(0.1, 0.1, 0.1))
    assert now.innovation(Summary.of(window, 1.0, reference="A")).statistic < 60.0


def test_another_sensitivity_in_the_certificate_moves_s_by_what_it_says() -> None:
    found = restarted(lived(), fresh(STATED), sensitivity=1.02)
    # The reference indicated 2 % less per m/s2 than was thought, so the motion was 2 % smaller and S is 2 % larger.
    ratio = found.result().sensitivity / lived().result().sensitivity
    np.testing.assert_allclose(np.diag(ratio), 1.02, rtol=0, atol=2e-4)
    assert found.result().standard_uncertainty[0] == pytest.approx(1.02 * u_of(lived())[0], rel=5e-3)


def test_a_date_stated_later_is_the_same_reference_and_another_date_is_a_new_calibration() -> None:
    dated = restarted(lived(), fresh(STATED), calibrated="2026-01-01")
    assert dated.references == ["A, calibrated 2026-01-01"]
    np.testing.assert_allclose(u_of(dated), u_of(lived()), rtol=1e-3)
    left_out = restarted(dated, fresh(STATED))
    assert left_out.reference == "A, calibrated 2026-01-01"
    anew = restarted(dated, fresh(STATED), calibrated="2027-01-01")
    for k in range(6):
        window = building_window(np.random.default_rng(k), level_mps2=(0.1, 0.1, 0.1))
        anew.update(Summary.of(window, 1.0 + k * HOUR, reference=anew.reference))
    assert anew.result().standard_uncertainty[0] == pytest.approx(3e-3 / np.sqrt(2.0), rel=0.03)


def test_a_calibration_put_back_does_not_count_the_error_of_the_reference_again() -> None:
    found = lived(12)
    for turn in range(8):
        found.put(lived(3).result())
        for k in range(4):
            window = building_window(np.random.default_rng(k), level_mps2=(0.1, 0.1, 0.1))
            found.update(Summary.of(window, 1.0 + turn + k * HOUR, reference="A"))
        assert found.result().standard_uncertainty[0] > 2.99e-3


@pytest.mark.parametrize("recent", [False, True])
def test_a_state_without_stated_means_is_finite_after_swaps_and_changes(recent: bool) -> None:
    """A regression test. A state of version 2 has no means of its priors. Those of the state, beside its base, stayed
    unknown; a swap of the reference kept them as first values; and the next change of a prior made all of it NaN."""
    snapshot = lived().snapshot()
    for of in ("state", "base"):
        snapshot[of]["stated_mean"] = np.full_like(snapshot[of]["stated_mean"], np.nan)
    if not recent:
        snapshot["recent"] = []
        snapshot["base"] = snapshot["state"]
    found = fresh(STATED)
    found.load(snapshot)
    found.restate()
    for reference in ("A", "B"):
        found.meet(reference)
    found = restarted(found, fresh(STATED | {"rotation_rad": 3.3e-3}))
    assert np.isfinite(found.lag_s)
    assert np.isfinite(found.result().covariance).all()
    assert np.isfinite(found.result().sensitivity).all()
