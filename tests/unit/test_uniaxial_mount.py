"""A sensor beside a uniaxial reference: a mount that does not turn leans, the direction is off, positions change."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.config import Channel, parse_config
from agent.core.estimation import Estimation
from calib.estimate.nuisances import Priors
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Pose, Window
from calib.state.state import State
from calib.windows.record import Record
from tests.building_windows import GRAVITY
from tests.clamp_windows import Q_TRUE, S_TRUE, window_of

RATE_HZ, SECONDS = 50.0, 60
TONES_HZ = (0.7, 1.3, 2.1, 3.7, 6.1)
UNIAXIAL = {"direction": (0.6, 0.8, 0.0), "gravity_mps2": GRAVITY.tolist()}
# S along gravity may have jumped as well where the motion has a part along it, and then says enough of Q by itself.
MOUNTS = {
    "across gravity": UNIAXIAL,
    "along gravity": UNIAXIAL | {"direction": (0.0, 0.0, 1.0)},
    "on a clamp": {"theta_deg": 0.0, "alpha_deg": 210.0},
}
CERTIFICATE = {
    "sensitivity": S_TRUE.ravel().tolist(),
    "u_main_pct": 0.2,
    "u_transverse_pct": 0.2,
    "offset_mps2": Q_TRUE.tolist(),
    "u_offset_mps2": 0.02,
}
# The reference stands along y and tells S_iy; what the data sheet says of the rest is next to nothing.
ALONG_Y = UNIAXIAL | {"direction": (0.0, 1.0, 0.0)}
DATA_SHEET = CERTIFICATE | {"u_transverse_pct": 20.0, "u_offset_mps2": 20.0}


def channel_of(pose: dict[str, Any], **more: Any) -> Channel:
    devices = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": RATE_HZ}} for n in "sr"]
    channel = {"sensor": "s", "reference": "r", "poses": [pose | {"start_s": 0.0, "stop_s": 1e8}], "prior": CERTIFICATE}
    return parse_config({"devices": devices, "channels": [channel | more]}, "").channels[0]


def pose_of(channel: Channel) -> Pose:
    return channel.poses[0].pose(channel.gravity_mps2, channel.static_sign, feels_gravity=True)


def turned(degrees: float, axis: tuple[float, float, float]) -> np.ndarray:
    """Rotation (3, 3) about a unit vector, Rodrigues."""
    x, y, z = axis
    cross, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.deg2rad(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def window(random: np.random.Generator, stated: Pose, direction: np.ndarray, gravity: np.ndarray) -> Window:
    """A minute of five tones along `direction`, under `gravity`; stated is `stated`."""
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    turn, phase = 2.0 * np.pi * np.array(TONES_HZ), random.uniform(0.0, 2.0 * np.pi, len(TONES_HZ))
    u = 0.2 * np.sin(np.outer(t, turn) + phase).sum(axis=1)
    du = 0.2 * (np.cos(np.outer(t, turn) + phase) * turn).sum(axis=1)
    V = (np.outer(u, direction) + gravity) @ S_TRUE.T + Q_TRUE + 0.005 * random.normal(size=(len(t), 3))
    return window_of(stated, u[:, None], du[:, None], V, SECONDS)


def hours(found: Estimation, windows: list[Window], first: int) -> list[str]:
    """What becomes of a window an hour."""
    judged = [found.judge(one, (first + k) / 24.0, 0.0, 20.0) for k, one in enumerate(windows)]
    return [one.decision.action for one in judged]


def settled(channel: Channel, random: np.random.Generator) -> tuple[Estimation, Pose]:
    found, stated = Estimation(channel, None), pose_of(channel)
    windows = [window(random, stated, stated.direction[:, 0], stated.gravity_mps2) for _ in range(10)]
    assert set(hours(found, windows, 0)) == {"take"}
    return found, stated


def leaning(found: Estimation, stated: Pose, random: np.random.Generator, degrees: float) -> list[str]:
    """Twelve windows of the mount with the sensor and its reference, turned about a horizontal axis."""
    up = stated.gravity_mps2 / np.linalg.norm(stated.gravity_mps2)
    axis = np.cross(up, (0.6, -0.8, 0.1))
    gravity = turned(degrees, tuple(axis / np.linalg.norm(axis))) @ stated.gravity_mps2
    return hours(found, [window(random, stated, stated.direction[:, 0], gravity) for _ in range(12)], 10)


@pytest.mark.one_case
@pytest.mark.parametrize("mount", MOUNTS)
def test_a_lean_of_the_mount_is_within_the_uncertainty_of_the_offset(mount: str) -> None:
    random = np.random.default_rng(1)
    found, stated = settled(channel_of(MOUNTS[mount]), random)
    before = found.in_force
    assert "adopt" in leaning(found, stated, random, 2.0)
    after = found.in_force
    assert found.gate.status in ("VALID", "RECALIBRATING")
    assert np.linalg.norm(after.offset - before.offset) > 0.3  # the data cannot tell the lean from an offset
    off = np.append(after.sensitivity.ravel(), after.offset) - np.append(S_TRUE.ravel(), Q_TRUE)
    assert np.all(np.abs(off) < 2.0 * after.standard_uncertainty)
    assert np.linalg.norm(after.standard_uncertainty[9:]) > 0.2


def test_a_mount_that_does_not_lean_keeps_its_uncertainty() -> None:
    random = np.random.default_rng(2)
    found, stated = settled(channel_of(UNIAXIAL), random)
    before = found.in_force.standard_uncertainty[9:]
    assert set(leaning(found, stated, random, 0.0)) == {"take"}
    assert np.linalg.norm(before) < 0.1
    assert np.all(found.in_force.standard_uncertainty[9:] < 1.01 * before)


def test_the_uncertainty_of_the_direction_is_that_of_the_angle() -> None:
    """The sensor was turned on its mount about the vertical, so that gravity does not tell."""
    known = {"angle_deg": 1.0, "tilt_deg": 0.1, "transverse_motion_pct": 0.0}
    channel = channel_of(ALONG_Y, uncertainty=known, prior=DATA_SHEET)
    random, found, stated = np.random.default_rng(3), Estimation(channel, None), pose_of(channel)
    direction = turned(1.4, (0.0, 0.0, 1.0)) @ stated.direction[:, 0]
    assert set(hours(found, [window(random, stated, direction, GRAVITY) for _ in range(6)], 0)) == {"take"}
    calibration = found.state.result()
    off = (calibration.sensitivity - S_TRUE).ravel()
    assert abs(off[1]) > 0.02
    assert np.all(np.abs(off) < 2.0 * calibration.standard_uncertainty[:9])
    assert calibration.standard_uncertainty[1] == pytest.approx(np.deg2rad(np.hypot(1.0, 0.1)), rel=0.02)


def test_a_direction_known_well_on_a_mount_that_may_lean() -> None:
    """What is stated of gravity does not widen what is stated of the direction."""
    known = {"angle_deg": 0.1, "tilt_deg": 3.0, "transverse_motion_pct": 0.0}
    found, _ = settled(channel_of(ALONG_Y, uncertainty=known, prior=DATA_SHEET), np.random.default_rng(4))
    u = found.state.result().standard_uncertainty
    assert u[1] == pytest.approx(np.deg2rad(np.hypot(0.1, 0.1)), rel=0.05)
    assert np.all(u[9:11] > 0.99 * np.deg2rad(3.0) * 9.80665)


def test_of_positions_left_long_ago_nothing_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Along gravity a position has unknowns of motion across it, in phase and in quadrature."""
    monkeypatch.setattr("calib.state.state.MOST_POSITIONS", 3)
    channel, random = channel_of(MOUNTS["along gravity"]), np.random.default_rng(11)
    prior, stated = channel.prior, pose_of(channel)
    u = prior.standard_uncertainty(prior.mean(None))
    found = State(prior.mean(None), u, Priors(), Wander(), TemperatureModel(), fixed=False)
    for k in range(5):
        one = window(random, replace(stated, position=f"p{k}"), stated.direction[:, 0], GRAVITY)
        found.update(Record.of(one, float(k)))
    assert {quantity.position for quantity in found.quantities} == {"", "p1", "p2", "p3", "p4"}  # p4 came after the day
    assert "transverse_a[p4]_quadrature" in found.names()
    assert [name for name in found.names() if "p0" in name] == []
