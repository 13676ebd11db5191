"""Waves move a platform below 1 Hz, and an engine on it above 25 Hz: no smooth response is told across the gap."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from calib import calibrate
from calib.geometry import beside
from calib.model import Array, Window, WindowSums
from calib.windows.bands import band_sums, below_gap_hz, motion_band_hz

RATE_HZ, ENGINE_HZ = 200.0, 24.9


def waves(random: np.random.Generator, n: int, to_hz: float = 1.0) -> Array:
    """(n, 3) of rms 1, from 0.08 Hz on."""
    at_hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    lines = np.fft.rfft(random.standard_normal((n, 3)), axis=0)
    lines *= np.where((at_hz >= 0.08) & (at_hz <= to_hz), 1.0 / np.maximum(at_hz, 0.08), 0.0)[:, None]
    motion = np.fft.irfft(lines, n, axis=0)
    return np.asarray(motion / motion.std())


def engine(random: np.random.Generator, n: int) -> Array:
    """(n, 3) three harmonics."""
    time_s = np.arange(n) / RATE_HZ
    tones = [
        size
        * random.uniform(0.3, 1.0, 3)
        * np.sin(2.0 * np.pi * k * ENGINE_HZ * time_s + random.uniform(0.0, 6.0))[:, None]
        for k, size in ((1, 0.02), (2, 0.01), (3, 0.004))
    ]
    return np.asarray(np.sum(tones, axis=0))


def window(u: Array) -> Window:
    """Of a sensor that shows u (n, 3) as it is."""
    sums = WindowSums(3, np.zeros(0), np.zeros((0, 9)), np.zeros((0, 9, 9)))
    bands = band_sums(u, np.gradient(u, 1.0 / RATE_HZ, axis=0), u.copy(), RATE_HZ)
    return Window(0.0, 60.0, beside(np.eye(3)), sums, True, "", len(u), 0, bands=bands)


def moved(seed: int, of_waves: float, to_hz: float = 1.0) -> Window:
    random = np.random.default_rng([25, seed])
    n = round(60.0 * RATE_HZ)
    return window(of_waves * waves(random, n, to_hz) + engine(random, n) + 1e-5 * random.standard_normal((n, 3)))


def test_the_motion_that_lasts_ends_below_the_gap() -> None:
    made = moved(0, 0.05)
    whole, lasts = motion_band_hz([made]), motion_band_hz([made], lasting=True)
    assert whole is not None
    assert lasts is not None
    assert whole[1] > 2.0 * ENGINE_HZ
    assert lasts[0] < 0.15
    assert 0.9 < lasts[1] < 1.5
    assert below_gap_hz([made]) == lasts[1]


@pytest.mark.parametrize(
    ("of_waves", "to_hz"),
    [(0.002, 1.0), (0.05, 9.0)],
    ids=["hardly any waves", "waves up to 1.5 octaves below the engine"],
)
def test_elsewhere_all_motion_counts(of_waves: float, to_hz: float) -> None:
    made = moved(1, of_waves, to_hz)
    assert below_gap_hz([made]) is None
    assert motion_band_hz([made], lasting=True) == motion_band_hz([made])


@pytest.mark.thorough
def test_files_of_such_a_platform_are_calibrated_below_the_gap() -> None:
    """They were refused: "the data determine none of the 12 parameters"."""
    random, n, corner_hz = np.random.default_rng([9, 1]), round(600.0 * RATE_HZ), 60.0
    at_hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    w = 9.0 * np.maximum(at_hz, 1e-3)  # the sea's spectrum, with a peak at a ninth of a Hz
    power = w**-5 * np.exp(-1.25 * w**-4) * at_hz**4 * (at_hz > 0.03) * (at_hz < 1.0)
    sea = np.fft.irfft(np.fft.rfft(random.standard_normal((n, 3)), axis=0) * np.sqrt(power)[:, None], n, axis=0)
    a = 0.05 * sea / sea.std() + engine(random, n)
    passed = 1.0 / (1.0 + 1j * at_hz / corner_hz)
    felt = np.fft.irfft(np.fft.rfft(a, axis=0) * passed[:, None], n, axis=0)
    S = np.eye(3) + 0.02 * random.standard_normal((3, 3))
    gravity, time_s = np.array([0.0, 0.0, 9.81]), np.arange(n) / RATE_HZ
    V = (felt + gravity) @ S.T + 3e-3 * random.standard_normal((n, 3))
    u = a + gravity + 5e-4 * random.standard_normal((n, 3))
    reference: dict[str, Any] = {"time_s": time_s} | dict(zip(("ax", "ay", "az"), u.T, strict=True))
    found = calibrate((time_s, V), reference, rotation=np.eye(3).ravel().tolist(), gravity=9.81)
    assert found.status == "valid", found.reasons
    assert found.reference_frequency_hz is not None
    assert found.reference_frequency_hz < 1.0
    stated = np.reshape(found.standard_uncertainty[:9], (3, 3))
    assert np.abs((found.sensitivity - S) / stated).max() < 4.0
    assert np.diag(stated).max() < 3e-3
