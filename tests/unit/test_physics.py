"""The equations of a window against a simulation that shares none of their code, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calib.estimate import physics
from calib.estimate.physics import Stack, Windows, rotation
from calib.model import Pose, Window
from calib.windows.record import Record
from tests.clamp_windows import G_MPS2, Q_TRUE, S_TRUE, sums_of

RATE_HZ, SECONDS = 400.0, 20.0
TONES_HZ = (1.0, 2.5, 4.0)
RATE_MPS3 = np.array([0.4, -0.3, 0.2])
GRAVITY = np.array([0.5, -1.0, np.sqrt(G_MPS2**2 - 1.25)])
D = np.array([[0.98, 0.1, 0.02], [-0.1, 0.99, 0.05], [0.01, -0.06, 1.0]])

Motion = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def motion(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Three channels, each with three whole tones of its own phase; and their derivatives."""
    phase = np.arange(9).reshape(3, 3) * 0.7
    omega = 2.0 * np.pi * np.array(TONES_HZ)
    u = np.stack([np.sin(omega * t[:, None] + phase[c]).sum(axis=1) for c in range(3)], axis=1)
    du = np.stack([(omega * np.cos(omega * t[:, None] + phase[c])).sum(axis=1) for c in range(3)], axis=1)
    return u, du


def going(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same while it grows all the time."""
    u, du = motion(t)
    return u + np.outer(t - SECONDS / 2.0, RATE_MPS3), du + RATE_MPS3


def record(V: Callable[[np.ndarray, np.ndarray], np.ndarray], of: Motion = motion) -> Record:
    """Of a window in which V is a function of time and of the motion at that time."""
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    u, du = of(t)
    pose = Pose("p", D, GRAVITY)
    noise = 1e-7 * np.random.default_rng(1).normal(size=(len(t), 3))
    window = Window(0.0, SECONDS, pose, sums_of(u, du, V(t, u) + noise, 10), True, "", len(t), 0)
    return Record.of(window, 0.0, 0.0, 30.0)


def inputs(**moved: np.ndarray | float) -> np.ndarray:
    found = np.zeros(physics.SIZE)
    found[physics.S], found[physics.Q] = S_TRUE.ravel(), Q_TRUE
    for name, value in moved.items():
        found[getattr(physics, name)] = value
    return found


TURN = np.array([0.03, -0.02, 0.05])
WORLDS: dict[str, tuple[dict[str, Any], Any]] = {
    "as stated": ({}, lambda _, u: (u @ D.T + GRAVITY) @ S_TRUE.T + Q_TRUE),
    "the sensor turned": (
        {"TURN": TURN, "TURN_GRAVITY": TURN},
        lambda _, u: (u @ D.T + GRAVITY) @ rotation(TURN).T @ S_TRUE.T + Q_TRUE,
    ),
    "late by 2 ms": ({"LAG": 2e-3}, lambda t, _: (motion(t - 2e-3)[0] @ D.T + GRAVITY) @ S_TRUE.T + Q_TRUE),
    "a reference that indicates more": (
        {"REFERENCE": np.array([0.01, -0.02, 0.03])},
        lambda _, u: ((u / (1.0 + np.array([0.01, -0.02, 0.03]))) @ D.T + GRAVITY) @ S_TRUE.T + Q_TRUE,
    ),
    "gravity and temperature": (
        {"GRAVITY": 0.02, "OVER_T": np.array([0.1, 0.0, -0.1, 0.0, 0.01, 0.0])},
        lambda _, u: (
            (u @ D.T + GRAVITY * (1.0 + 0.02 / G_MPS2)) @ S_TRUE.T
            + Q_TRUE + np.array([0.1, 0.0, -0.1]) * 10.0 + np.array([0.0, 0.01, 0.0]) * 100.0
        ),
    ),
}  # fmt: skip


@pytest.mark.parametrize("world", WORLDS)
def test_it_predicts_the_slopes_and_means_of_samples(world: str) -> None:
    moved, V = WORLDS[world]
    own = record(V)
    windows = Windows(Stack.of([own], fixed=False), 20.0, at_hz=0.0, share=0.0, known_size=0.0)
    slopes, means = windows.predicted(inputs(**moved)[None])
    unit = np.linalg.norm(own.root, axis=1).max()
    # (omega lag)^3 / 6 at 4 Hz and 2 ms is 2e-5 for each of three tones, which no term of the equations has.
    np.testing.assert_allclose(slopes[0] / unit, own.slopes / unit, rtol=0, atol=4e-5)
    np.testing.assert_allclose(means[0], own.means, rtol=0, atol=2e-5)


def test_late_indications_of_a_motion_that_grows_have_the_mean_of_an_earlier_time() -> None:
    own = record(lambda t, _: (going(t - 2e-3)[0] @ D.T + GRAVITY) @ S_TRUE.T + Q_TRUE, going)
    windows = Windows(Stack.of([own], fixed=False), 20.0, at_hz=0.0, share=0.0, known_size=0.0)
    means = windows.predicted(inputs(LAG=2e-3)[None])[1]
    np.testing.assert_allclose(means[0], own.means, rtol=0, atol=2e-5)  # 2 ms of 0.2 to 0.4 m/s3 are 4e-4 and more


def test_the_derivatives_are_those_of_the_prediction() -> None:
    own = record(WORLDS["as stated"][1])
    windows = Windows(Stack.of([own], fixed=False), 20.0, at_hz=2.0, share=0.3, known_size=0.01)
    random, live = np.random.default_rng(2), np.arange(physics.SIZE)
    scale = np.where(np.arange(physics.SIZE) < 9, 0.1, 1e-2)
    scale[physics.LAG], scale[physics.RESPONSE] = 1e-3, 1e-5
    p = inputs() + scale * random.normal(size=physics.SIZE)
    _, _, d_slope, d_mean = windows.linear(p[None], p[None], live)
    for k in range(physics.SIZE):
        share = 1.0 if physics.RESPONSE.start <= k < physics.RESPONSE.stop else 1e-4  # linear in the response
        step = share * scale[k] * np.eye(physics.SIZE)[k]
        pairs = [windows.predicted((p + sign * step)[None]) for sign in (1.0, -1.0)]
        for found, values in zip((d_slope, d_mean), zip(*pairs, strict=True), strict=True):
            expected = ((values[0] - values[1]) / (2.0 * share * scale[k])).ravel()
            size = np.abs(expected).max() + 1e-9
            if physics.TURN.start <= k < physics.TURN_GRAVITY.stop:
                continue  # turned from the left: the sum of rotation vectors has another derivative
            np.testing.assert_allclose(found[0, :, k] / size, expected / size, rtol=0, atol=1e-4, err_msg=str(k))


def test_more_windows_than_are_taken_at_once_have_the_same_derivatives(monkeypatch: pytest.MonkeyPatch) -> None:
    own = record(WORLDS["as stated"][1])
    windows = Windows(Stack.of([own] * 3, fixed=False), 20.0, at_hz=2.0, share=0.3, known_size=0.01)
    p, live = np.tile(inputs(), (3, 1)), np.array([0, 4, 9])
    expected = windows.linear(p, p, live)
    monkeypatch.setattr(physics, "AT_ONCE", 2)
    for found, before in zip(windows.linear(p, p, live), expected, strict=True):
        np.testing.assert_array_equal(found, before)


@pytest.mark.parametrize("where", [physics.TURN, physics.TURN_GRAVITY])
def test_a_turn_is_perturbed_from_the_left(where: slice) -> None:
    """So a common turn of all positions stays exactly a turn of S, however far each position is turned."""
    own = record(WORLDS["as stated"][1])
    windows = Windows(Stack.of([own], fixed=False), 20.0, at_hz=0.0, share=0.0, known_size=0.0)
    p = inputs(TURN=0.3 * TURN, TURN_GRAVITY=4.0 * TURN)
    slope, mean, d_slope, d_mean = windows.linear(p[None], p[None], np.arange(where.start, where.stop))
    for axis in range(3):
        small, found = 1e-6 * np.eye(3)[axis], []
        for sign in (1.0, -1.0):
            turned = p.copy()
            both = rotation(sign * small) @ rotation(p[where])
            angle = np.arccos((np.trace(both) - 1.0) / 2.0)
            axes = np.array([both[2, 1] - both[1, 2], both[0, 2] - both[2, 0], both[1, 0] - both[0, 1]])
            turned[where] = axes * angle / (2.0 * np.sin(angle))
            found.append(windows.predicted(turned[None]))
        for own_d, k in ((d_slope, 0), (d_mean, 1)):
            expected = ((found[0][k] - found[1][k]) / 2e-6).ravel()
            np.testing.assert_allclose(own_d[0, :, axis], expected, rtol=0, atol=1e-4 * (np.abs(expected).max() + 1e-9))
    assert slope.shape[1] == 18
    assert mean.shape[1] == 3


LATE_S = 0.006  # 0.11 rad of the tones' mean frequency: of second order, 0.6 %


def test_the_slopes_of_a_window_tell_its_own_lag() -> None:
    late = record(lambda t, _: (motion(t - LATE_S)[0] @ D.T + GRAVITY) @ S_TRUE.T + Q_TRUE)
    left_s, u_s = late.lag_left_s
    assert left_s == pytest.approx(LATE_S, rel=0.01)  # of first order: the front end takes it out and looks again
    assert 0.0 < u_s < 1e-6
    resting = record(lambda t, _: np.tile(GRAVITY @ S_TRUE.T, (len(t), 1)), lambda t: (np.zeros((len(t), 3)),) * 2)
    assert resting.lag_left_s == (0.0, np.inf)


@pytest.mark.parametrize("u_lag_s", [0.0, 0.5 * LATE_S])
def test_an_own_lag_that_was_taken_out_makes_no_slope_smaller(u_lag_s: float) -> None:
    """The common lag differs by LATE_S from what was taken out. Where the clocks leave as much open of a window's own
    lag, its samples are in time; else the lag is left in them, and makes the slopes smaller."""
    in_time = record(lambda _, u: (u @ D.T + GRAVITY) @ S_TRUE.T + Q_TRUE)
    windows = Windows(Stack.of([replace(in_time, u_lag_s=u_lag_s)], fixed=False), at_hz=0.0, share=0.5, known_size=0.0)
    before, same, after = (windows.predicted(inputs(LAG=lag_s)[None])[0] for lag_s in (-LATE_S, 0.0, LATE_S))
    smaller = 0.0 if u_lag_s else LATE_S**2 * in_time.omega2
    np.testing.assert_allclose(before + after, (2.0 - smaller) * same, rtol=0.0, atol=1e-9 * np.abs(same).max())
