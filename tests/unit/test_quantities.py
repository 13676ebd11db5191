"""The table of unknowns: every number that is stated reaches the estimator, in its unit, at its name."""

from __future__ import annotations

import numpy as np
import pytest

from agent.calibrate.stated import options_of
from agent.cli.calibrate import calibrate
from agent.config.knowledge import (
    AT_FIXED_MOUNT,
    Certificate,
    Knowledge,
    Prior,
    Process,
    StatedFields,
    Temperature,
    Uncertainty,
)
from agent.config.knowledge import WALKS as WALKS_STATED
from calib.estimate.nuisances import Priors
from calib.estimate.quantities import KINDS, WALKS
from calib.estimate.wander import TemperatureModel, Wander
from calib.recorded.options import STATED as BY_OPTION
from calib.recorded.priors import priors_of

STATED = Knowledge(
    prior=Prior(sensitivity=1.0, corner_hz=0.2, u_corner_hz=0.03, reference_frequency_hz=4.0),
    certificate=Certificate(
        u_sensitivity_pct=0.7, lag_s=0.003, u_lag_s=0.0003, corner_hz=0.1, u_corner_hz=0.02, stability_pct=0.6,
        u_sensitivity_pct_per_k=0.03, u_transverse_pct=1.3,
    ),
    uncertainty=Uncertainty(
        angle_deg=1.0, theta_deg=2.0, theta_position_deg=3.0, alpha_common_deg=4.0, rotation_deg=5.0, tilt_deg=6.0,
        transverse_motion_pct=7.0, offset_mps2=0.08, offset_position_mps2=0.09, gravity_mps2=0.01, lag_s=0.0004,
        lag_window_s=0.0011,
    ),
    process=Process(
        sensitivity_pct=0.02, offset_mps2=0.003, offset_rate_mps2=0.004, offset_rate_walk_mps2=5e-5, tilt_deg=0.006,
    ),
)  # fmt: skip
DEG = 0.017453292519943295
OF_THE_CONFIGURATION = {
    "angle_rad": DEG, "theta_rad": 2 * DEG, "theta_position_rad": 3 * DEG, "alpha_common_rad": 4 * DEG,
    "rotation_rad": 5 * DEG, "transverse": 0.07, "offset_mps2": 0.08, "offset_position_mps2": 0.09,
    "gravity_mps2": 0.01, "lag_s": 0.0005, "lag_at_s": -0.003, "lag_window_s": 0.0011, "reference": 0.007,
    "reference_transverse": 0.013, "reference_drift": 0.006, "reference_per_k": 3e-4, "reference_corner_at_hz": 0.1,
    "reference_corner_hz": 0.02, "sensor_corner_at_hz": 0.2, "sensor_corner_hz": 0.03, "reference_frequency_hz": 4.0,
}  # fmt: skip
AT_A_FIXED_MOUNT = {"gravity_direction_rad": 6 * DEG, "lean_rad": 6 * DEG, "tilt_rad": 0.0}
WHERE_IT_TURNS = {"gravity_direction_rad": DEG, "lean_rad": 0.0, "tilt_rad": 0.0}
OF_THE_OPTIONS = {
    "reference_frequency_hz": (5.0, {"reference_frequency_hz": 5.0}),
    "u_angle_deg": (1.0, {"angle_rad": DEG, "gravity_direction_rad": DEG}),
    "u_theta_deg": (2.0, {"theta_rad": 2 * DEG}),
    "u_theta_position_deg": (3.0, {"theta_position_rad": 3 * DEG}),
    "u_alpha_common_deg": (4.0, {"alpha_common_rad": 4 * DEG}),
    "u_offset_mps2": (0.08, {"offset_mps2": 0.08}),
    "u_offset_position_mps2": (0.09, {"offset_position_mps2": 0.09}),
    "u_reference_pct": (0.7, {"reference": 0.007}),
    "u_reference_transverse_pct": (1.3, {"reference_transverse": 0.013}),
    "u_transverse_motion_pct": (7.0, {"transverse": 0.07}),
    "u_tilt_deg": (6.0, {"tilt_rad": 6 * DEG}),
    "u_rotation_deg": (5.0, {"rotation_rad": 5 * DEG}),
    "u_gravity_mps2": (0.01, {"gravity_mps2": 0.01}),
    "u_reference_corner_hz": (0.02, {"reference_corner_hz": 0.02}),
    "reference_corner_hz": (0.1, {"reference_corner_at_hz": 0.1}),
    "u_sensor_corner_hz": (0.03, {"sensor_corner_hz": 0.03}),
    "sensor_corner_hz": (0.2, {"sensor_corner_at_hz": 0.2}),
}


@pytest.mark.parametrize(("fixed", "more"), [(True, AT_A_FIXED_MOUNT), (False, WHERE_IT_TURNS)])
def test_priors_of_a_channel(fixed: bool, more: dict[str, float]) -> None:
    values = STATED.priors(fixed_mount=fixed).values
    assert {name: values[name] for name in OF_THE_CONFIGURATION | more} == pytest.approx(OF_THE_CONFIGURATION | more)


def test_walks_of_a_channel() -> None:
    expected = {
        "sensitivity": 2e-4, "offset_mps2": 0.003, "offset_rate_mps2": 0.004, "offset_rate_walk_mps2": 5e-5,
        "tilt_rad": 0.006 * DEG, "reference_drift": 0.006 / 365.25**0.5,
    }  # fmt: skip
    assert STATED.wander().values == pytest.approx(expected)


def test_where_no_temperature_is_stated_it_is_20_degc_for_files_and_streams() -> None:
    assert Temperature().model.reference_degc == TemperatureModel().reference_degc == 20.0


def test_every_number_that_the_configuration_may_state_is_tried_here() -> None:
    assert set(AT_FIXED_MOUNT) == {*OF_THE_CONFIGURATION, *AT_A_FIXED_MOUNT} - {"tilt_rad"}
    assert {option for option, _ in BY_OPTION.values()} == set(OF_THE_OPTIONS)


@pytest.mark.parametrize("option", OF_THE_OPTIONS)
def test_an_option_of_calibrate_moves_what_it_names_and_nothing_else(option: str) -> None:
    files = ["--sensor", "s.csv", "--reference", "r.csv", "--poses", "p.csv"]
    options = calibrate.make_context("calibrate", files).params
    value, expected = OF_THE_OPTIONS[option]
    before, after = (priors_of(options_of(told)) for told in (options, options | {option: value}))
    assert {n: v for n, v in after.values.items() if v != before.values[n]} == pytest.approx(expected)


@pytest.mark.parametrize("stated", [Priors, Wander])
def test_none_is_all_zero_and_a_name_that_is_not_there_is_refused(stated: type[Priors] | type[Wander]) -> None:
    assert set(stated.none().values.values()) == {0.0}
    with pytest.raises(TypeError, match=f"{stated.__name__} has no lagg_s; it has "):
        stated(lagg_s=0.1)
    with pytest.raises(AttributeError, match="lagg_s"):
        stated().lagg_s  # noqa: B018


def test_one_number_is_replaced_and_the_others_stay() -> None:
    found = Priors({"gravity_mps2": 0.2}, lag_s=0.5).with_values({"angle_rad": 0.1})
    assert (found.angle_rad, found.lag_s, found.gravity_mps2) == (0.1, 0.5, 0.2)


def test_what_wanders_wanders_by_its_own_walk() -> None:
    walks = Wander({name: float(k + 1) for k, name in enumerate(WALKS)})
    assert {kind.name for kind in KINDS.values() if walks.of(kind.walk) > 0.0} == {
        "sensitivity", "offset", "offset rate", "tilt", "lean", "gravity direction by position", "reference drift"
    }  # fmt: skip
    found = np.sqrt(walks.variance_a_day(10.0, 2.0))
    assert found[:9] == pytest.approx(10.0 * walks.sensitivity)
    assert found[9:] == pytest.approx(10.0 * np.hypot(walks.offset_mps2, 2.0 * walks.tilt_rad))


@pytest.mark.parametrize("setting", [*AT_FIXED_MOUNT.values(), *WALKS_STATED.values()], ids=lambda s: s.fields[0])
def test_every_setting_is_in_the_configuration(setting: StatedFields) -> None:
    for place in setting.fields:
        section, field = place.split(".")
        assert isinstance(getattr(getattr(STATED, section), field), float)
