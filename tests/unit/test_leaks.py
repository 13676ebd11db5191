"""Motion at one frequency leaks into the bands beside it: there it says nothing of their response."""

from __future__ import annotations

import numpy as np
import pytest

from calib.model import Array, BandSums
from calib.windows.bands import HANN, TAPER, band_sums, beside_reference_noise, without_noise

RATE_HZ, N = 250.0, 15_000


def bands_hz(u: Array, share: float) -> Array:
    """(B, 2) the bands of motion u (n,) that are kept."""
    moved = np.column_stack([u, u, u])
    found = band_sums(moved, np.gradient(moved, 1.0 / RATE_HZ, axis=0), moved, RATE_HZ, share)
    assert found is not None
    return np.column_stack([found.low_hz, found.high_hz])


@pytest.mark.parametrize("hz", [6.0, 6.007, 6.0083])
def test_of_a_tone_without_noise_its_own_band_is_kept_alone(hz: float) -> None:
    """On a line of the spectrum, between two, and elsewhere."""
    kept = bands_hz(np.sin(2.0 * np.pi * hz * np.arange(N) / RATE_HZ), TAPER)
    near = kept[(kept[:, 1] > 4.0) & (kept[:, 0] < 9.0)]
    assert len(near) == 1
    assert near[0, 0] <= hz <= near[0, 1]


@pytest.mark.parametrize("share", [TAPER, HANN])
def test_of_broad_motion_all_bands_are_kept(share: float) -> None:
    """Also of a motion whose density falls by a factor of 1000 at 6 Hz: what leaks over the edge is less."""
    random = np.random.default_rng(5)
    lines = np.fft.rfft(random.standard_normal(N))
    every = len(bands_hz(np.fft.irfft(lines, N), share))
    lines[np.fft.rfftfreq(N, 1.0 / RATE_HZ) > 6.0] *= 0.03
    assert len(bands_hz(np.fft.irfft(lines, N), share)) >= every - 1


def test_white_noise_of_a_hundredth_beside_a_tone_is_kept_but_for_the_band_beside_it() -> None:
    noise = np.random.default_rng(1).normal(size=N)
    tone = np.sin(2.0 * np.pi * 6.007 * np.arange(N) / RATE_HZ)
    assert len(bands_hz(tone + 0.01 * noise, TAPER)) >= len(bands_hz(noise, TAPER)) - 1


def test_weak_motion_between_two_tones_is_kept() -> None:
    """A hundredth of the amplitude of the tones, from 4 to 9 Hz."""
    random, time_s = np.random.default_rng(6), np.arange(N) / RATE_HZ
    tones = np.sin(2.0 * np.pi * 3.3 * time_s) + np.sin(2.0 * np.pi * 11.7 * time_s)
    lines = np.fft.rfft(random.standard_normal(N))
    lines[np.abs(np.fft.rfftfreq(N, 1.0 / RATE_HZ) - 6.5) > 2.5] = 0.0
    weak = np.fft.irfft(lines, N)
    kept = bands_hz(tones + 0.01 * weak / weak.std(), TAPER)
    assert kept[(kept[:, 0] > 4.2) & (kept[:, 1] < 8.8)].shape[0] >= 5


def test_white_noise_is_taken_out_up_to_the_frequency_at_which_it_ends() -> None:
    """White noise of the rms n up to f has the rms 2 pi f n / sqrt(3) in its rate; bands up to f hold all of both."""
    n, end_hz, edges_hz = 0.01, 20.0, np.linspace(0.0, 20.0, 5)
    rate = 2.0 * np.pi * end_hz * n / np.sqrt(3.0) * (1.0 + 1e-9)
    strong = np.tile(1e6 * np.eye(5), (4, 1, 1))
    bands = BandSums(1, edges_hz[:-1], edges_hz[1:], np.full(4, 50.0), 1.0, strong, np.zeros((4, 5)), np.ones(4))
    found = without_noise(beside_reference_noise(bands, np.array([[n], [rate]]), 200.0))
    np.testing.assert_allclose(found.noise[:, 0], np.full(4, 50.0 * n**2), rtol=1e-6)
    shares = np.diff((edges_hz / end_hz) ** 3)
    np.testing.assert_allclose(found.noise[:, 1], 200.0 * rate**2 * shares, rtol=1e-6)
    np.testing.assert_allclose(found.products[:, 0, 0], 1e6 - found.noise[:, 0], rtol=1e-12)
