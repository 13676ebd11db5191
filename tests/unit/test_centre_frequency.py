"""The frequency around which the motion of a window is, where S holds at first."""

from __future__ import annotations

import numpy as np
import pytest

from calib.model import Pose, Window
from calib.windows.bands import band_sums
from calib.windows.record import Record
from tests.clamp_windows import sums_of

RATE_HZ, SECONDS = 125.0, 60.0


def of_tones(*tones: tuple[float, float]) -> Record:
    """The record of a window in which tones (frequency in Hz, m/s2) move all axes, each with its own phase."""
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    u, du = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    for hz, size in tones:
        phase = 2.0 * np.pi * hz * t[:, None] + 7.0 * hz * np.array([0.0, 2.0, 5.0])
        u += size * np.sin(phase)
        du += 2.0 * np.pi * hz * size * np.cos(phase)
    V = u + 1e-4 * np.random.default_rng(1).normal(size=u.shape)
    window = Window(
        0.0, SECONDS, Pose("p", np.eye(3), np.array([0.0, 0.0, 9.8])), sums_of(u, du, V, 10), True, "", len(t), 0,
        bands=band_sums(u, du, V, RATE_HZ),
    )  # fmt: skip
    return Record.of(window, 0.0)


@pytest.mark.parametrize("hz", [0.4, 3.0, 25.0])
def test_of_one_tone_it_is_exact(hz: float) -> None:
    found = of_tones((hz, 0.05))
    assert found.motion_hz is None
    assert found.centre_hz == found.mean_hz == pytest.approx(hz, rel=1e-3)


def test_waves_and_an_engine_are_around_the_waves() -> None:
    """By power, the mean frequency of waves and of a seventh as much at 25 Hz is 10 Hz, at which nothing moves, and
    where no window ever tells S."""
    found = of_tones((0.16, 0.03), (0.2, 0.03), (0.24, 0.03), (24.9, 0.015), (25.0, 0.015))
    assert found.motion_hz is None
    assert found.mean_hz > 5.0
    assert 0.15 < found.centre_hz < 1.0
