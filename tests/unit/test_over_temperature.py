"""S and Q over temperature: by default where a temperature is told, and no trace of it where none is."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from pydantic import ValidationError

from agent.config.knowledge import Temperature
from agent.core.snapshot import pack, unpack
from agent.export.samples import acceleration
from benchmarks.online.temperature import Drawn, World, estimation, over_u
from calib.estimate.estimate import estimate
from calib.estimate.nuisances import Priors
from calib.estimate.statements import Statements
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import PARAMETERS, Pose
from calib.state.state import State
from calib.state.thinning import merged
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.clamp_windows import Q_TRUE, S_TRUE
from tests.drawn_records import UP, Truth, template, told
from tests.unit.results import calibration

MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.where(np.eye(3).ravel() > 0, 0.05, 0.03), np.full(3, 20.0))
STILL = Wander({**Wander.none().values, "offset_rate_mps2": 1e-9})
PRIORS = Priors(gravity_mps2=0.03, offset_mps2=1e-3, lag_window_s=0.0, reference=1e-3, reference_per_k=2e-4)
BY_DEFAULT = TemperatureModel(1, 1, settles=True)
OF_S = np.array([[1e-4, 2e-4, 0.0], [-3e-4, -1e-4, 0.0], [0.0, 1e-4, 2e-4]])
OF_Q = np.array([0.005, -0.01, 0.0])
POSES = [Pose(str(k), np.eye(3), UP[[k % 3, (k + 1) % 3, (k + 2) % 3]] * (-1.0) ** k) for k in range(6)]


def turning(*, offset_mps2: float = 1e-6, reference_per_k: float = 0.0) -> Statements:
    priors = Priors.none().with_values({"offset_mps2": offset_mps2, "reference_per_k": reference_per_k})
    return Statements(MEAN, U, {"": priors}, STILL, TemperatureModel(1, 1, 10.0))


def records(degc: np.ndarray, noise: float = 1e-6) -> list[Record]:
    """Of a mount that turns, one at each temperature; S holds at 10 degC."""
    made = [template(pose, noise=noise) for pose in POSES]
    truth = [Truth(S_TRUE + OF_S * (t - 10.0), Q_TRUE + OF_Q * (t - 10.0)) for t in degc.tolist()]
    return [
        told(made[k % 6], own, float(k), degc=t) for k, (own, t) in enumerate(zip(truth, degc.tolist(), strict=True))
    ]


def state(model: TemperatureModel, degc: list[float]) -> State:
    """After a window at each of these temperatures, at a fixed mount."""
    found, random = State(MEAN, U, PRIORS, STILL, model, fixed=True), np.random.default_rng(3)
    for k, t in enumerate(degc):
        found.update(Record.of(building_window(random, level_mps2=(0.1, 0.1, 0.1)), k / 24, 0.0, t))
    return found


def test_all_nine_elements_are_told_where_the_mount_turns() -> None:
    now = estimate(records(np.linspace(-5.0, 25.0, 24)), turning()).now
    for names, expected, scale in (("S{}{}_T1", OF_S, 1e-7), ("Q{}_T1", OF_Q[:, None], 1e-5)):
        for (i, j), value in np.ndenumerate(expected):
            assert abs(now.mean[now.index(names.format("xyz"[i], "xyz"[j]))] - value) < scale


def test_what_the_reference_may_do_with_temperature_is_in_u_away_from_that_of_s_and_not_at_it() -> None:
    own, at_zero = records(np.linspace(-5.0, 25.0, 24), noise=0.005), []
    for per_k in (0.0, 2e-4):
        now = estimate(own, turning(offset_mps2=100.0, reference_per_k=per_k)).now
        u = np.sqrt(now.variance[[now.index(f"S{axis}_T1") for axis in ("xx", "yy", "zz")]])
        # The windows tell the difference of the two alone, whose priors are alike.
        np.testing.assert_allclose(u, per_k / np.sqrt(2.0), rtol=0.05, atol=6e-6)
        at_zero.append(np.sqrt(now.variance[:9]))
    np.testing.assert_allclose(at_zero[1], at_zero[0], rtol=0.01)


def test_a_merged_record_has_the_temperature_of_the_motion_that_tells_s() -> None:
    """By day it is warm, and the traffic shakes ten times as much as by night."""
    at = {10.0: template(POSES[0], (0.1, 0.1, 0.1)), 18.0: template(POSES[0], (1.0, 1.0, 1.0))}
    both = [told(own, Truth(S_TRUE + OF_S * (t - 10.0), Q_TRUE), 0.01 * t, degc=t) for t, own in at.items()]
    one = merged(both, S_TRUE)
    found = (np.linalg.pinv(one.root) @ one.slopes)[:3].T
    np.testing.assert_allclose(found, S_TRUE + OF_S * (one.temperature_degc - 10.0), rtol=0, atol=1e-9)


def test_where_no_temperature_is_told_nothing_is_another() -> None:
    untold = [float("nan")] * 4
    by_default, constant = state(BY_DEFAULT, untold), state(TemperatureModel(1, 0), untold)
    assert by_default.names() == constant.names()
    np.testing.assert_array_equal(by_default.covariance(), constant.covariance())
    np.testing.assert_array_equal(by_default.result().sensitivity, constant.result().sensitivity)
    assert by_default.reference_temperature_degc == constant.reference_temperature_degc == 20.0


def test_without_a_swing_u_is_that_of_a_constant() -> None:
    """Windows at 5 degC: S and Q are told at 5 degC, not at 20."""
    cold = [5.2] * 6
    by_default, constant = state(BY_DEFAULT, cold), state(TemperatureModel(1, 0, 5.0), cold)
    ratio = by_default.result().standard_uncertainty / constant.result().standard_uncertainty
    assert ratio.min() > 0.999
    assert ratio.max() < 1.01
    assert by_default.reference_temperature_degc == 5.0
    beyond = by_default.law().at(25.0).standard_uncertainty[4]
    assert beyond == pytest.approx(np.hypot(20.0 * 2e-4, constant.result().standard_uncertainty[4]), rel=0.01)


def test_the_first_temperature_that_is_told_stays_that_of_s_and_q() -> None:
    found = state(BY_DEFAULT, [float("nan"), 7.6, 12.0, 14.0])
    assert found.reference_temperature_degc == 8.0
    other = State(MEAN, U, PRIORS, STILL, BY_DEFAULT, fixed=True)
    other.load(unpack(pack(found.snapshot())))
    assert other.reference_temperature_degc == 8.0
    assert pack(other.snapshot()) == pack(found.snapshot())


@pytest.mark.slow
def test_a_body_that_is_two_hours_behind_the_thermometer_contradicts_nothing() -> None:
    """25 K a day, and transverse sensitivities that change by 0.03 %/K."""
    world = World("", 25.0, transverse=3e-4, late_h=2.0)
    drawn, found = Drawn(world, np.random.default_rng(1)), estimation(constant=False)
    judged = [found.judge(drawn.window(k / 24), k / 24, 0.0, drawn.degc(k / 24)) for k in range(30)]
    assert {one.decision.action for one in judged} == {"take"}
    error = found.law.at(drawn.degc(29 / 24)).sensitivity - drawn.truth(drawn.body_degc(29 / 24))[:9].reshape(3, 3)
    assert np.abs(error).max() < 0.015  # three times the rotation of 0.2 deg


@pytest.mark.slow
def test_a_window_without_a_temperature_may_have_had_any_of_those_before() -> None:
    """A thermometer that fails after a day and a half of 25 K, with 0.03 %/K: S stays, and U covers what it may be."""
    drawn, found = Drawn(World("", 25.0, transverse=3e-4), np.random.default_rng(5)), estimation(constant=False)
    for k in range(48):
        degc = drawn.degc(k / 24) if k < 36 else float("nan")
        assert found.judge(drawn.window(k / 24), k / 24, 0.0, degc).decision.action == "take"
    error = over_u(found.law.at(float("nan")), drawn.truth(drawn.body_degc(47 / 24)))
    assert np.abs(error).max() < 3.0


def test_the_order_of_s_follows_that_of_q_and_can_be_stated() -> None:
    for offset, stated, order in ((1, None, 1), (2, None, 1), (0, None, 0), (1, 0, 0), (2, 1, 1)):
        section = Temperature(offset_order=offset, sensitivity_order=stated)
        assert (section.model.offset_order, section.model.sensitivity_order) == (offset, order)
    with pytest.raises(ValidationError, match="sensitivity_order 1 needs offset_order 1 or 2"):
        Temperature(offset_order=0, sensitivity_order=1)


def test_exported_samples_are_corrected_at_their_temperature() -> None:
    per_k = [[20.0, 1.0, 0.0], [0.0, -10.0, 0.0], [2.0, 0.0, 5.0]]
    update = msgspec.structs.replace(
        calibration(1), reference_temperature_degc=10.0, sensitivity_per_k=per_k, offset_temperature=[[1.0, 0.0, -2.0]]
    )
    a = np.array([[0.5, -1.0, 9.8]])
    V = (
        a @ (np.array(update.sensitivity) + 15.0 * np.array(per_k)).T
        + update.offset
        + 15.0 * np.array([1.0, 0.0, -2.0])
    )
    found = acceleration(V, update, 25.0)
    assert found is not None
    np.testing.assert_allclose(found, a, rtol=1e-12)


def test_each_element_of_s_and_q_may_follow_the_temperature_late() -> None:
    names = [quantity.name for quantity, _ in TemperatureModel(1, 1, 10.0, settles=True).behind(1.0)]
    assert names == [f"{name}_behind" for name in PARAMETERS]
