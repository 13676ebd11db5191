"""A sensor that stays at several positions of a clamp on a shaker, beside a laser vibrometer, as a logger writes both.

The motion is a sum of tones, so that acceleration and velocity are exact at any time. Geometry and clocks are written
out here again, so that calib's own are not tested by themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import calib
from calib.recorded.outcome import Outcome

Array = NDArray[np.float64]
G_MPS2 = 9.80665
S_TRUE = 1000.0 * np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
Q_TRUE = np.array([360.0, -60.0, 165.0])
THETA_DEG, ALPHAS_DEG = 35.0, (0.0, 90.0, 180.0, 270.0)
REFERENCE_HZ = 500.0
MAIN = [0, 4, 8]


@dataclass(frozen=True, slots=True, eq=False)
class Stays:
    """True times (n,) and indications (n, 3) of the sensor, times and velocities of the reference, and the poses."""

    time_s: Array
    indications: Array
    reference_time_s: Array
    velocity_mps: Array
    poses: list[dict[str, float]]

    def calibrated(self, stamp_s: Array, later_s: float = 0.0, **options: Any) -> Outcome:
        """The outcome where the sensor's samples have these stamps, and the reference's time is `later_s` more."""
        poses = [{**p, "start_s": p["start_s"] + later_s, "stop_s": p["stop_s"] + later_s} for p in self.poses]
        reference = {"time_s": self.reference_time_s + later_s, "v": self.velocity_mps}
        return calib.calibrate((stamp_s, self.indications), reference, poses, **options)


Struck = Callable[[np.random.Generator, Array], Array]


def stays(
    seed: int, *, rate_hz: float, on_s: float, off_s: float = 0.0, motion_hz: tuple[float, float] = (2.0, 20.0),
    struck: Struck | None = None, noise: float = 20.0,
) -> Stays:  # fmt: skip
    """The sensor stays `on_s` at each position, at `rate_hz` in truth; in between it is off for `off_s`. What `struck`
    makes of the times of the samples (n,), (n, 3) in output unit, is added."""
    random = np.random.default_rng(seed)
    tones_hz = random.uniform(*motion_hz, 40)
    level = 4.0 * random.normal(size=(2, 40)) / np.sqrt(40.0)

    def moved(time_s: Array, derivatives: int) -> Array:
        """(n,) the velocity, or its first derivative."""
        turn = 2.0 * np.pi * tones_hz
        lines = (level[0] + 1j * level[1]) * (1j * turn) ** (derivatives - 1)
        out = np.zeros(len(time_s))
        for line, omega in zip(lines, turn, strict=True):
            out += (line * np.exp(1j * omega * time_s)).real
        return out

    times, values, poses = [], [], []
    for k, alpha_deg in enumerate(ALPHAS_DEG):
        start_s = k * (on_s + off_s)
        theta, alpha = np.deg2rad([THETA_DEG, alpha_deg])
        d = np.array([-np.sin(alpha) * np.cos(theta), -np.cos(alpha) * np.cos(theta), np.sin(theta)])
        e = np.array([-np.sin(theta) * np.sin(alpha), -np.sin(theta) * np.cos(alpha), -np.cos(theta)])
        first, stop = np.ceil([start_s * rate_hz, (start_s + on_s) * rate_hz])
        time_s = np.arange(first, stop) / rate_hz
        felt = np.outer(moved(time_s, 1), d) + G_MPS2 * e
        times.append(time_s)
        values.append(felt @ S_TRUE.T + Q_TRUE + noise * random.normal(size=(len(time_s), 3)))
        poses.append({
            "start_s": start_s, "stop_s": start_s + on_s, "theta_deg": THETA_DEG, "alpha_deg": alpha_deg,
        })  # fmt: skip
    time_s, indications = np.concatenate(times), np.concatenate(values)
    if struck is not None:
        indications += struck(random, time_s)
    reference_time_s = np.arange(-3.0, poses[-1]["stop_s"] + 3.0, 1.0 / REFERENCE_HZ)
    velocity = moved(reference_time_s, 0) + 2e-5 * random.normal(size=len(reference_time_s))
    return Stays(time_s, indications, reference_time_s, velocity, poses)


def knocked(rate_hz: float, duration_s: float = 0.02, peak_mps2: float = 8.0) -> Struck:
    """Knocks of the sensor alone: half-sines at random times in random directions, each of 0.3 to 1 of the peak."""

    def struck(random: np.random.Generator, time_s: Array) -> Array:
        felt = np.zeros((len(time_s), 3))
        for at_s in random.uniform(time_s[0], time_s[-1], random.poisson(rate_hz * (time_s[-1] - time_s[0]))):
            direction, size = random.normal(size=3), peak_mps2 * random.uniform(0.3, 1.0)
            during = (time_s >= at_s) & (time_s < at_s + duration_s)
            shape = np.sin(np.pi * (time_s[during] - at_s) / duration_s)
            felt[during] += np.outer(size * shape, direction / np.linalg.norm(direction))
        return felt @ S_TRUE.T

    return struck


def in_batches(time_s: Array, size: int, late_s: Array | float = 0.0) -> Array:
    """The stamps (n,) of samples that arrive in batches of `size`, each `late_s` (batches,) after its newest sample."""
    batch = np.arange(len(time_s)) // size
    newest = np.minimum((batch + 1) * size, len(time_s)) - 1
    late = np.broadcast_to(late_s, batch[-1] + 1)
    return np.maximum.accumulate(time_s[newest] + late[batch])


def errors(outcome: Outcome) -> Array:
    """(12,) errors of a valid outcome."""
    assert outcome.status == "valid", outcome.reasons
    return np.asarray(outcome.values - np.append(S_TRUE.ravel(), Q_TRUE))


def main_errors_pct(outcome: Outcome) -> Array:
    """(3,) errors of the main sensitivities of a valid outcome."""
    return np.asarray(100.0 * errors(outcome)[MAIN] / S_TRUE.ravel()[MAIN])
