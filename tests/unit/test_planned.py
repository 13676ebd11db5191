"""The plan of stated positions: against the agent that takes them, and against closed formulas."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from agent.bench.planned import missing_stops, plan_of
from agent.config import Channel, Config, parse_config
from agent.core.estimation import Estimation
from calib.model import Pose, Window
from tests.clamp_windows import window_of

G = 9.80665
RATE_HZ, SECONDS, RMS_MPS2, NOISE = 50.0, 60, 5.0, 0.02
TONES_HZ = (0.7, 1.3, 2.1, 3.7, 6.1)
S_TRUE = np.array([[1.02, 0.01, -0.015], [0.008, 0.985, 0.012], [-0.01, 0.013, 1.01]])
Q_TRUE = np.array([0.1, -0.2, 0.15])
MAX_CHANGE = np.append(np.where(np.eye(3).ravel() > 0, 0.05, 0.03), np.full(3, 0.5))  # defaults of the gate
EXACT = {"u_sensitivity_pct": 1e-6, "stability_pct": 0.0}  # the plan leaves the reference's own error out


def configured(poses: list[dict[str, Any]], **more: Any) -> Config:
    devices = [
        {"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": RATE_HZ, "axes": axes}}
        for n, axes in (("s", 3), ("r", 1))
    ]
    held = [pose | {"start_s": 100.0 * k, "stop_s": 100.0 * k + 90.0} for k, pose in enumerate(poses)]
    channel = {"sensor": "s", "reference": "r", "poses": held, "prior": {}, "certificate": EXACT}
    return parse_config({"devices": devices, "channels": [channel | more]}, "test")


def clamped(*angles: tuple[float, float]) -> list[dict[str, Any]]:
    return [{"theta_deg": float(theta), "alpha_deg": float(alpha)} for theta, alpha in angles]


def window(random: np.random.Generator, pose: Pose) -> Window:
    """A minute of five tones with 5 m/s2 rms, as the plan expects the motion."""
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    turn, phase = 2.0 * np.pi * np.array(TONES_HZ), random.uniform(0.0, 2.0 * np.pi, len(TONES_HZ))
    each = RMS_MPS2 * np.sqrt(2.0 / len(TONES_HZ))
    u = each * np.sin(np.outer(t, turn) + phase).sum(axis=1)
    du = each * (np.cos(np.outer(t, turn) + phase) * turn).sum(axis=1)
    gravity = np.where(np.isnan(pose.gravity_mps2), 0.0, pose.gravity_mps2)
    V = (np.outer(u, pose.direction[:, 0]) + gravity) @ S_TRUE.T + Q_TRUE + NOISE * random.normal(size=(len(t), 3))
    return window_of(pose, u[:, None], du[:, None], V, SECONDS)


def taken(channel: Channel, times: int) -> Estimation:
    """The agent's estimation once each position was taken so many times."""
    found, random = Estimation(channel, 1.0), np.random.default_rng(1)
    felt = channel.coupling == "dc"
    poses = [one.pose(channel.gravity_mps2, channel.static_sign, feels_gravity=felt) for one in channel.poses]
    for k, pose in enumerate(poses * times):
        found.judge(window(random, pose), k / 24.0, 0.0, 20.0)
    return found


SETS: dict[str, tuple[list[dict[str, Any]], dict[str, Any]]] = {
    "three alphas": (clamped((35, 0), (35, 120), (35, 240)), {}),
    "two alphas": (clamped((35, 0), (35, 120)), {}),
    "two alphas, two thetas": (clamped((35, 0), (35, 120), (55, 0)), {}),
    "theta 0": (clamped((0, 0), (0, 120), (0, 240)), {}),
    "alphas near each other": (clamped((35, 0), (35, 20), (35, 40)), {}),
    "one position": (clamped((35, 0)), {}),
    "two alphas, and six parameters are enough": (clamped((35, 0), (35, 120)), {"gate": {"least_determined": 6}}),
    "two alphas of a certified sensor": (
        clamped((35, 0), (35, 120)),
        {"prior": {"u_main_pct": 1.0, "u_transverse_pct": 1.0}},
    ),
    "AC-coupled": (clamped((35, 0), (35, 120), (35, 240)), {"coupling": "ac"}),
    "AC-coupled, two alphas": (clamped((35, 0), (35, 120)), {"coupling": "ac"}),
    "directions without gravity": ([{"direction": row} for row in np.eye(3).tolist()], {}),
}


@pytest.mark.one_case
@pytest.mark.parametrize("name", SETS)
def test_what_is_planned_is_what_the_agent_reaches(name: str) -> None:
    """Which parameters are determined, whether a first calibration comes of it, and U once each was taken."""
    poses, more = SETS[name]
    channel = configured(poses, **more).channels[0]
    plan, once, often = plan_of(channel, 1.0), taken(channel, 1), taken(channel, 6)
    assert plan.enough == (often.gate.status == "VALID")
    first = np.sqrt(np.diag(Estimation(channel, 1.0).state.covariance()))
    last = np.sqrt(np.diag(often.state.covariance()))
    reached = (last < 0.5 * first) | (2.0 * first <= MAX_CHANGE)  # as docs/vocabulary.md and docs/gate.md say
    clear = np.abs(last / first - 0.5) > 0.1
    np.testing.assert_array_equal(plan.determined[clear], reached[clear])
    u = np.sqrt(np.diag(once.state.covariance()))
    measured = np.append(2.0 * u[:9].reshape(3, 3) / np.diag(S_TRUE)[:, None], 2.0 * u[9:])
    worst = [measured[k].max() for k in ([0, 4, 8], [1, 2, 3, 5, 6, 7], [9, 10, 11])]
    told = [plan.expanded[k].max() for k in ([0, 4, 8], [1, 2, 3, 5, 6, 7], [9, 10, 11])]
    np.testing.assert_allclose(told, worst, rtol=0.15, atol=5e-4)  # less noise is planned than there is here


def test_six_sides_by_a_closed_formula() -> None:
    """Two rests along an axis: u(S) = u(offset) / (g sqrt(2)). All six tell Q: u(Q) = u(offset) / sqrt(6)."""
    faces = [(sign * G * row).tolist() for row in np.eye(3) for sign in (1.0, -1.0)]
    held = [{"gravity_mps2": face} for face in faces]
    stated = {"offset_mps2": 0.05, "angle_deg": 0.0, "gravity_mps2": 0.0}
    config = configured([], positions=held, reference=None, uncertainty=stated)
    plan = plan_of(config.channels[0], 1.0)
    np.testing.assert_allclose(plan.expanded[[0, 4, 8]], 2.0 * 0.05 / (G * np.sqrt(2.0)), rtol=0.01)
    np.testing.assert_allclose(plan.expanded[9:], 2.0 * 0.05 / np.sqrt(6.0), rtol=0.01)
    assert plan.enough


@pytest.mark.thorough
def test_the_proposed_positions_are_enough_and_fewer_are_not() -> None:
    """For clamps of any inclination with one or two positions, as many positions as determine all twelve."""
    random = np.random.default_rng(5)
    for _ in range(10):
        theta, alpha = random.uniform(20, 60), random.uniform(0, 180)
        poses = clamped((theta, alpha), (theta, alpha + random.uniform(40, 180)))
        channel = configured(poses).channels[0]
        assert not plan_of(channel, 1.0).enough
        more = missing_stops(channel, 1.0)
        assert plan_of(configured([*poses, *(stop.columns for stop in more)]).channels[0], 1.0).enough
        assert not plan_of(configured([*poses, *(stop.columns for stop in more[:-1])]).channels[0], 1.0).enough


@pytest.mark.slow
def test_a_day_of_poses_is_planned_soon() -> None:
    angles = [(35.0, float(k % 360)) for k in range(20_000)]
    began_s = time.process_time()
    assert plan_of(configured(clamped(*angles)).channels[0], 1.0).enough
    assert time.process_time() - began_s < 10.0
