"""Memory of windows beside a tri-axial reference: a day of 1 kHz has 1440 of them, and may take 400 MB in all."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from calib.adjustment.adjustment import adjust
from calib.estimate.nuisances import Priors
from calib.excitation.windows import Points, motion_windows
from calib.geometry import beside
from calib.model import Window
from calib.recorded.segments import with_joined
from calib.windows.bands import TAPER, lowest_hz, motion_band_hz

RATE_HZ, LENGTH_S = 1000.0, 60.0
JOINED = 6  # segments, as in a day
S = np.array([[1.02, 0.01, -0.02], [0.0, 0.98, 0.01], [0.015, -0.01, 1.01]])


@pytest.fixture(autouse=True)
def traced() -> Iterator[None]:
    tracemalloc.start(1)
    yield
    tracemalloc.stop()


def made(count: int) -> list[Window]:
    """Windows of a minute each, with motion from 0.5 to 12 Hz in three directions."""
    n, windows = int(RATE_HZ * LENGTH_S), []
    lines = np.arange(30, 720, 12)
    omega = 2.0 * np.pi * np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    for k in range(count):
        rng = np.random.default_rng(k)
        spectrum = np.zeros((len(omega), 3), complex)
        spectrum[lines] = np.exp(2j * np.pi * rng.random((len(lines), 3)))
        a, da = (np.fft.irfft(x, n, axis=0) for x in (spectrum, 1j * omega[:, None] * spectrum))
        scale = 3.0 / a.std(axis=0)
        u, du = a * scale + [0.0, 0.0, 9.80665], da * scale
        V = u @ S.T + 0.02 * rng.normal(size=u.shape)
        points = Points(60.0 * k + np.arange(n) / RATE_HZ, V, u, du)
        (window,) = motion_windows(beside(np.eye(3)), points, taper=TAPER)
        assert window.used, window.reason
        noise = np.array([[1e-3] * 3, [1.0] * 3])
        windows.append(replace(window, sums=with_joined(window.sums, JOINED), reference_noise=noise))
    return windows


@pytest.mark.slow
def test_a_window_keeps_its_sums_and_no_samples() -> None:
    made(1)  # what is cached is there
    before = tracemalloc.get_traced_memory()[0]
    windows = made(4)
    kept = (tracemalloc.get_traced_memory()[0] - before) / len(windows)
    assert kept < 65e3


def peak(windows: Sequence[Window], priors: Priors) -> int:
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    assert not adjust(windows, priors).reasons
    return tracemalloc.get_traced_memory()[1] - before


@pytest.mark.slow
def test_an_adjustment_needs_less_memory_than_its_windows() -> None:
    windows = made(4)
    band_hz = motion_band_hz(windows)
    assert band_hz is not None
    priors = Priors().with_response(band_hz, from_hz=lowest_hz(windows))
    few, many = (peak([replace(w) for w in windows * times], priors) for times in (5, 25))
    assert (many - few) / (20 * len(windows)) < 45e3
