"""What is stated anew holds as if it had been stated so from the beginning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.estimate.nuisances import Priors
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Calibration
from calib.state.state import State, _equal
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.clamp_windows import Q_TRUE, S_TRUE

HOUR = 1.0 / 24.0
STEADY = dict.fromkeys(Wander.none().values, 0.0)
STATED = {"reference": 3e-3, "rotation_rad": 3e-3, "gravity_mps2": 0.03, "lag_s": 0.005, "offset_mps2": 0.02}
MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.where(np.eye(3).ravel() > 0, 0.05, 0.03), np.full(3, 1.0))


def fresh(stated: dict[str, float], temperature: TemperatureModel | None = None, mean: np.ndarray = MEAN) -> State:
    priors = Priors(dict(Priors.none().values) | stated)
    return State(mean, U, priors, Wander(STEADY), temperature or TemperatureModel(), fixed=False)


def lived(windows: int = 6, error: float = 0.0, **begun: object) -> State:
    """A state after windows of an hour each, the temperature between 15 and 25 deg C."""
    random, found = np.random.default_rng(1), fresh(STATED, **begun)  # type: ignore[arg-type]
    found.meet("A")
    for k in range(windows):
        window = building_window(random, level_mps2=(0.1, 0.1, 0.1), reference_error=error)
        found.update(Record.of(window, k * HOUR, 0.0, 15.0 + 2.0 * (k % 6), "A"))
    return found


def u_of(found: State) -> np.ndarray:
    return found.result().standard_uncertainty


def restarted(before: State, now: State, **certificate: object) -> State:
    now.load(before.snapshot())
    now.restate()
    now.meet("A", **certificate)  # type: ignore[arg-type]
    return now


@pytest.mark.slow
def test_another_order_of_the_temperature_begins_again_with_the_kept_windows_and_loses_nothing() -> None:
    order = TemperatureModel(offset_order=1)
    found = restarted(lived(), fresh(STATED, order))
    exact = lived(temperature=order)
    # The windows are weighed by the noise of all windows now; at first each was weighed by those before it.
    np.testing.assert_allclose(u_of(found), u_of(exact), rtol=5e-3)
    np.testing.assert_allclose(found.result().sensitivity, exact.result().sensitivity, rtol=0, atol=2e-5)
    back = restarted(found, fresh(STATED))
    assert "Qx_T1" not in back.names()
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
    assert now.innovation(Record.of(window, 1.0, reference="A")).statistic < 60.0


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
    assert left_out.reference() == "A, calibrated 2026-01-01"
    anew = restarted(dated, fresh(STATED), calibrated="2027-01-01")
    for k in range(6):
        window = building_window(np.random.default_rng(k), level_mps2=(0.1, 0.1, 0.1))
        anew.update(Record.of(window, 1.0 + k * HOUR, reference=anew.reference()))
    assert anew.result().standard_uncertainty[0] == pytest.approx(3e-3 / np.sqrt(2.0), rel=0.03)


@pytest.mark.slow
def test_a_calibration_put_back_does_not_count_the_error_of_the_reference_again() -> None:
    found = lived(12)
    for turn in range(4):
        found.put(lived(3).result())
        for k in range(4):
            window = building_window(np.random.default_rng(k), level_mps2=(0.1, 0.1, 0.1))
            found.update(Record.of(window, 1.0 + turn + k * HOUR, reference="A"))
        assert found.result().standard_uncertainty[0] > 2.99e-3


def test_what_changes_the_covariance_alone_is_a_change() -> None:
    one = Calibration(np.eye(3), np.zeros(3), np.eye(12), np.ones(12, dtype=bool), np.inf, "")
    assert _equal(one, replace(one, covariance=np.eye(12)))
    for other in ({"covariance": 2.0 * np.eye(12)}, {"sensitivity": 2.0 * np.eye(3)}, {"offset": np.ones(3)}):
        assert not _equal(one, replace(one, **other))
