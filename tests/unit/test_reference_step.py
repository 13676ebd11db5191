"""A confirmed step that the reference could have made: S follows it, and U covers that S may not have changed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.config import parse_config
from agent.core.estimation import Estimation
from calib.model import Window
from tests.building_windows import GRAVITY, building_window
from tests.clamp_windows import S_TRUE, Faults, clamp_points

SYY, STEP = 4, 0.03
ALONG_Y = np.array([0.0, STEP, 0.0])
CERTIFICATE = {"u_sensitivity_pct": 0.1, "stability_pct": 0.5}
PRIOR = {"sensitivity": S_TRUE.ravel().tolist(), "u_main_pct": 1.0, "u_transverse_pct": 0.5}
ALPHAS_DEG = (0.0, 60.0, 120.0, 180.0, 240.0, 300.0)


def beside(**certificate: Any) -> Estimation:
    """Of a sensor on a fixed mount beside a tri-axial reference."""
    return estimation(
        3,
        rotation=np.eye(3).ravel().tolist(),
        rotation_gravity_mps2=GRAVITY.tolist(),
        certificate=CERTIFICATE | certificate,
        uncertainty={"offset_mps2": 0.002},
    )


def on_the_clamp() -> Estimation:
    poses = [
        {"start_s": 40.0 * k, "stop_s": 40.0 * k + 30, "theta_deg": 35, "alpha_deg": alpha_deg}
        for k, alpha_deg in enumerate(ALPHAS_DEG)
    ]
    uncertainty = {"offset_mps2": 0.02, "gravity_mps2": 0.003}
    return estimation(1, poses=poses, certificate=CERTIFICATE, uncertainty=uncertainty)


def estimation(axes: int, **channel: Any) -> Estimation:
    devices = [
        {"name": name, "driver": "serial-csv", "options": {"port": name, "rate_hz": 50.0, "axes": n}}
        for name, n in (("s", 3), ("r", axes))
    ]
    stated = {"sensor": "s", "reference": "r", "prior": PRIOR, "temperature": {"offset_order": 0}} | channel
    return Estimation(parse_config({"devices": devices, "channels": [stated]}, "").channels[0], None)


def days(found: Estimation, first: int, windows: list[Window]) -> list[str]:
    """What becomes of a window a day."""
    return [found.judge(w, float(first + k), 0.0, 20.0).decision.action for k, w in enumerate(windows)]


def windows(seed: int, number: int, **more: Any) -> list[Window]:
    random = np.random.default_rng(seed)
    return [building_window(random, level_mps2=(0.1, 0.1, 0.1), **more) for _ in range(number)]


def stepped(found: Estimation, seed: int = 1, **step: Any) -> Estimation:
    """Six windows before the step, and the five that confirm it."""
    assert set(days(found, 0, windows(seed, 6))) == {"take"}
    assert days(found, 10, windows(seed + 100, 5, **step))[-1] == "adopt"
    return found


def u_of(found: Estimation) -> np.ndarray:
    return found.in_force.standard_uncertainty


@pytest.mark.one_case
@pytest.mark.parametrize(("step", "true"), [({"reference_error": ALONG_Y}, 0.0), ({"S": S_TRUE * (1 + ALONG_Y)}, STEP)])
def test_after_a_step_of_reference_or_sensor_u_covers_both_and_stays(step: dict[str, Any], true: float) -> None:
    found = stepped(beside(), **step)
    shown = STEP if true else -STEP / (1 + STEP)
    assert found.in_force.sensitivity[1, 1] == pytest.approx(S_TRUE[1, 1] * (1 + shown), rel=5e-3)
    u = u_of(found)[SYY]
    assert u == pytest.approx(S_TRUE[1, 1] * abs(shown) / 1.6, rel=0.1)
    assert abs(found.in_force.sensitivity[1, 1] - S_TRUE[1, 1] * (1 + true)) < 2 * u
    assert u_of(found)[[0, 8]].max() < 2e-3  # the channels that did not step
    assert set(days(found, 15, windows(7, 12, **step))) == {"take"}
    assert u_of(found)[SYY] == pytest.approx(u, rel=0.01)


@pytest.mark.slow
def test_a_small_step_is_as_uncertain_as_the_reference_is_stable() -> None:
    found = stepped(beside(stability_pct=2.5), reference_error=ALONG_Y)
    assert u_of(found)[SYY] == pytest.approx(0.025 * S_TRUE[1, 1], rel=0.05)


@pytest.mark.slow
def test_a_reference_that_does_not_drift_made_no_step() -> None:
    assert u_of(stepped(beside(stability_pct=0.0), reference_error=ALONG_Y))[SYY] < 2e-3


@pytest.mark.slow
def test_a_turn_of_the_sensor_is_no_step_of_the_reference() -> None:
    turn = np.eye(3) + 0.02 * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    found = stepped(beside(), S=S_TRUE @ turn)
    assert u_of(found)[[0, 4, 8]].max() < 2e-3


@pytest.mark.slow
def test_another_reference_tells() -> None:
    found = beside()
    found.meet("A", "", 1.0)
    stepped(found, reference_error=ALONG_Y)
    found.meet("B", "", 1.0)
    assert set(days(found, 15, windows(8, 6))) == {"take"}
    assert abs(found.in_force.sensitivity[1, 1] - S_TRUE[1, 1]) < 3 * u_of(found)[SYY] < 6e-3


@pytest.mark.thorough
def test_on_a_turning_mount_gravity_tells_that_it_was_the_reference() -> None:
    random, found = np.random.default_rng(3), on_the_clamp()

    def turned(number: int, error: float) -> list[Window]:
        alphas = [(alpha,) for alpha in (ALPHAS_DEG * number)[:number]]
        made = [clamp_points(random, Faults(offset_mps2=0.02), alphas_deg=a, repetitions=1).windows[0] for a in alphas]
        return [shown_by(window, error) for window in made]

    days(found, 0, turned(36, 0.0))
    before = found.in_force
    assert "adopt" in days(found, 36, turned(12, STEP))
    days(found, 48, turned(24, STEP))
    drift, u = found.state.quantity("reference_drift")
    assert abs(drift - STEP) < 3 * u < 0.6 * STEP
    assert np.all(np.abs(found.in_force.sensitivity - S_TRUE).ravel() < 3 * u_of(found)[:9])
    assert np.all(u_of(found)[[0, 4, 8]] < 1.2 * before.standard_uncertainty[[0, 4, 8]])


def shown_by(window: Window, error: float) -> Window:
    """The same window of a uniaxial reference that is wrong by this share."""
    felt = np.diag([1 + error, 1 + error, 1.0, 1.0, 1.0])
    sums = window.sums
    return replace(window, sums=replace(sums, mean=sums.mean @ felt, scatter=felt @ sums.scatter @ felt))


@pytest.mark.slow
def test_nothing_is_forgotten_in_a_snapshot() -> None:
    found = stepped(beside(), reference_error=ALONG_Y)
    again = beside()
    again.load(found.snapshot())
    for one in (found, again):
        days(one, 15, windows(9, 3, reference_error=ALONG_Y))
    assert np.array_equal(found.in_force.covariance, again.in_force.covariance)
