"""Windows of a sensor beside a tri-axial AC-coupled reference at a fixed mount, with known truth, for the state."""

from __future__ import annotations

import numpy as np

from calib.model import Pose, Window
from tests.clamp_windows import G_MPS2, Q_TRUE, S_TRUE, sums_of

GRAVITY = np.array([0.0, 0.0, G_MPS2])
BESIDE = Pose("beside", np.eye(3), GRAVITY)
RATE_HZ, SECONDS, SEGMENTS = 50.0, 60, 60
OMEGA = 2 * np.pi * np.array([0.7, 1.3, 2.1, 3.7, 6.1])
TURNED = np.outer(np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ, OMEGA)
WAVES = np.hstack([np.sin(TURNED), np.cos(TURNED)])


def building_window(
    random: np.random.Generator,
    *,
    level_mps2: tuple[float, float, float] = (0.0, 0.1, 0.0),
    S: np.ndarray = S_TRUE,
    Q: np.ndarray = Q_TRUE,
    noise_mps2: float = 0.005,
    reference_noise_mps2: float = 0.0,
    reference_error: float | np.ndarray = 0.0,
    direction: np.ndarray | None = None,
    gravity_mps2: np.ndarray = GRAVITY,
) -> Window:
    """A minute of five tones between 0.7 and 6 Hz in each direction, phases drawn; white noise in both.

    `direction` (3,): what would go along y goes that way, and nothing else.
    """
    phase = random.uniform(0, 2 * np.pi, (3, len(OMEGA))).T
    cos, sin = (np.sqrt(0.4) * np.array(level_mps2) * x for x in (np.cos(phase), np.sin(phase)))
    a, da = WAVES @ np.vstack([cos, sin]), WAVES @ np.vstack([-OMEGA[:, None] * sin, OMEGA[:, None] * cos])
    if direction is not None:
        a, da = (np.outer(x[:, 1], direction) for x in (a, da))
    V = (a + gravity_mps2) @ S.T + Q + noise_mps2 * random.normal(size=a.shape)
    u = a * (1.0 + reference_error) + reference_noise_mps2 * random.normal(size=a.shape)
    return Window(0.0, SECONDS, BESIDE, sums_of(u, da, V, SEGMENTS), True, "", len(a), 0)
