"""Records of windows whose truth is drawn: made at the level of records, without samples, by equations of their own.

The equations of a window are written out here a second time (see calib.estimate.physics), so that the estimator is not
tested by itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calib.model import Pose, Window
from calib.windows.record import Record
from calib.windows.type_a import LEVELS, SUMS
from hw.virtual.schedule import rotation
from tests.clamp_windows import G_MPS2, sums_of

RATE_HZ, SECONDS = 50.0, 20.0
UP = np.array([0.0, 0.0, G_MPS2])
TONES_HZ = (0.7, 1.3, 2.1)


def _none() -> np.ndarray:
    return np.zeros(3)


@dataclass(frozen=True)
class Truth:
    """What a window had: S, Q, and the errors of its pose, its reference and its times, as the statements name them."""

    S: np.ndarray
    Q: np.ndarray
    turn_rad: np.ndarray = field(default_factory=_none)  # of the motion
    turn_gravity_rad: np.ndarray = field(default_factory=_none)
    across: np.ndarray = field(default_factory=_none)  # motion that a uniaxial reference does not measure, relative
    ahead: np.ndarray = field(default_factory=_none)  # the same, 90 deg ahead
    reference: np.ndarray = field(default_factory=_none)  # its channels indicate more by so much, relative
    gravity_mps2: float = 0.0
    lag_s: np.ndarray = field(default_factory=_none)  # of the axes


def template(pose: Pose, level_mps2: tuple[float, ...] = (1.0, 1.0, 1.0), noise: float = 1e-6, seed: int = 1) -> Record:
    """A record of this pose with three tones in each channel of its reference, and white noise of this SD a point."""
    random, m = np.random.default_rng(seed), pose.direction.shape[1]
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    u, du = np.zeros((len(t), m)), np.zeros((len(t), m))
    for k in range(m):
        for f in TONES_HZ:
            omega, phase = 2.0 * np.pi * f, random.uniform(0.0, 2.0 * np.pi)
            u[:, k] += level_mps2[k] * np.sin(omega * t + phase)
            du[:, k] += level_mps2[k] * omega * np.cos(omega * t + phase)
    V = u @ pose.direction.T + pose.gravity_mps2 + noise * random.normal(size=(len(t), 3))
    window = Window(0.0, SECONDS, pose, sums_of(u - u.mean(axis=0), du, V, 20), True, "", len(t), 0)
    white = {"noise": np.full(3, noise), "scores": scatter(1.0, 1e4), "mean_x": np.zeros(2 * m)}
    return replace(Record.of(window, 0.0), **white, held_mps2=pose.gravity_mps2)  # type: ignore[arg-type]


def scatter(ratio: float, freedom: float) -> np.ndarray:
    """The sums of a window whose slopes and means scatter so many times more than white noise makes them."""
    found = np.zeros((2, LEVELS, SUMS))
    found[:, 0, :5] = freedom, 1.0, freedom + 1.0, 1.0, ratio * freedom
    return found


def told(
    record: Record, truth: Truth, day: float, *, degc: float = 20.0, reference: str = "A",
    slope_noise: np.ndarray | float = 0.0, mean_noise: np.ndarray | float = 0.0,
) -> Record:  # fmt: skip
    """The record of a window on a day with this truth. `slope_noise` (2M, 3) and `mean_noise` (3,) are added."""
    m, pose = record.channels, record.pose
    turn, omega = _turn(truth.turn_rad), np.sqrt(record.omega2)
    moved = pose.direction.copy()
    moved[:, 0] += truth.across
    D = turn @ moved / (1.0 + truth.reference[:m])
    on_rate = -truth.lag_s[:, None] * (truth.S @ D)
    if omega:
        on_rate[:, 0] += truth.S @ turn @ truth.ahead / omega
    slopes = record.root @ np.vstack([(truth.S @ D).T, on_rate.T]) + slope_noise
    size = float(np.linalg.norm(pose.gravity_mps2))
    gravity = _turn(truth.turn_gravity_rad) @ pose.gravity_mps2 * (1.0 + truth.gravity_mps2 / (size or 1.0))
    mean_u, mean_rate = np.split(record.mean_x, 2)
    moving = truth.S @ D @ mean_u - truth.lag_s * (truth.S @ D @ mean_rate)
    means = (truth.S @ gravity + moving + truth.Q + mean_noise)[None]
    return replace(
        record, day=day, days=(day, day), slopes=slopes, means=means, reference=reference, temperature_degc=degc,
        over_t=np.array([[1.0, degc, degc**2]]),
    )  # fmt: skip


def _turn(vector: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(vector))
    return rotation(vector / angle, angle) if angle else np.eye(3)
