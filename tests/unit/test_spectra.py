"""Power in third octaves, noise floor, and what outliers do to them, against noise and motion that are known."""

from __future__ import annotations

import numpy as np
import pytest

from calib.model import Array
from calib.signal.spectra import PAIRS, Bands, bands_of, noise_floor, robust_power, segment_of, turned

RATE_HZ = 20.0
MIXED = np.array([[1.0, 0.0, 0.0], [0.8, 1.0, 0.0], [-0.7, 0.3, 2.0]])


def minutes(x: Array, bands: Bands) -> tuple[Array, Array]:
    """The power (n, 6, B) and the floor (n, 3, G) of whole segments of x (3, n * samples)."""
    made = [segment_of(part, bands, np.eye(3)) for part in np.split(x, x.shape[1] // bands.samples, axis=1)]
    return np.array([one.power for one in made]), np.array([one.floor for one in made])


def test_bands_are_third_octaves_of_the_standard_within_their_limits() -> None:
    bands = bands_of(200.0)
    assert bands.samples == 12000
    # 10^(-11/10) Hz is the first whose lower edge is above 1/16 Hz, 63 Hz the last whose upper one is below 80 Hz
    assert bands.centre_hz[[0, -1]] == pytest.approx([10.0**-1.1, 10.0**1.8], rel=1e-12)
    assert np.diff(np.log10(bands.centre_hz)) == pytest.approx(np.full(len(bands.centre_hz) - 1, 0.1), abs=1e-12)
    assert bands.edges_hz[1:, 0] == pytest.approx(bands.edges_hz[:-1, 1], rel=1e-12)
    fast = bands_of(4000.0)  # 16 s: the lowest bands would be narrower than a line
    assert (fast.samples, round(fast.centre_hz[0], 3)) == (1 << 16, 0.316)
    assert len(bands_of(0.2).centre_hz) == 0


@pytest.mark.thorough
def test_power_and_cross_power_of_white_noise() -> None:
    """60 hours of 60 segments, seed 1: each number within 5 standard errors and the 3 % of the median's share."""
    bands, rng = bands_of(RATE_HZ), np.random.default_rng(1)
    hours = []
    for _ in range(60):
        power, floor = minutes(MIXED @ rng.standard_normal((3, 60 * bands.samples)), bands)
        hours.append(np.append(robust_power(power, bands), noise_floor(floor, bands)))
    found, covariance = np.array(hours), MIXED @ MIXED.T * 2.0 / RATE_HZ
    width_hz = np.diff(bands.edges_hz)[:, 0]
    expected = np.append(np.array([covariance[i, k] * width_hz for i, k in PAIRS]), covariance.diagonal())
    own = np.array([np.sqrt(covariance[i, i] * covariance[k, k]) * width_hz for i, k in PAIRS])
    allowed = 5.0 * found.std(axis=0, ddof=1) / np.sqrt(60.0) + 0.03 * np.append(own, covariance.diagonal())
    assert (np.abs(found.mean(axis=0) - expected) < allowed).all()
    assert (allowed < 0.25 * np.append(own, covariance.diagonal())).all()


@pytest.mark.two_cases
@pytest.mark.parametrize("count", [1, 2, 3, 5, 12])
def test_few_segments_have_no_other_mean_than_many(count: int) -> None:
    """The lowest band, whose lines are the fewest: 4000 hours of `count` segments, seed 2, within 3 %."""
    bands, rng = bands_of(RATE_HZ), np.random.default_rng(2)
    power, _ = minutes(rng.standard_normal((3, 400 * bands.samples)), bands)
    chosen = rng.integers(0, len(power), (4000, count))
    found = np.mean([robust_power(power[own], bands)[:3, 0] for own in chosen])
    assert abs(found / power[:, :3, 0].mean() - 1.0) < 0.04


def test_a_sine_is_in_its_band_with_its_mean_square() -> None:
    bands = bands_of(RATE_HZ)
    t = np.arange(bands.samples) / RATE_HZ
    at = int(np.argmin(np.abs(bands.centre_hz - 2.0)))
    sine = 0.3 * np.sin(2.0 * np.pi * bands.centre_hz[at] * t + 1.0)
    power, _ = minutes(np.array([sine, -0.5 * sine, 9.8 + 0.0 * sine]), bands)
    assert power[0, 0, at] == pytest.approx(0.045, rel=1e-3)
    assert power[0, 3, at] == pytest.approx(-0.0225, rel=1e-3)
    assert power[0, 2].max() < 1e-20
    assert np.delete(power[0, 0], at).max() < 1e-4 * 0.045


def test_knocks_in_a_third_of_the_minutes_move_the_power_by_their_rank_alone() -> None:
    bands, rng = bands_of(RATE_HZ), np.random.default_rng(3)
    x = rng.standard_normal((3, 60 * bands.samples))
    quiet = robust_power(minutes(x, bands)[0], bands)
    x[:, 600 :: 3 * bands.samples] += 100.0
    knocked = robust_power(minutes(x, bands)[0], bands)
    # the median is then the upper quartile, at most twice it; a mean would be 8 times as large
    assert (knocked[:3] / quiet[:3]).mean(axis=0).max() < 2.2
    assert np.mean(minutes(x, bands)[0][:, 0, -1]) > 3.0 * quiet[0, -1]


def test_motion_in_most_lines_is_no_noise() -> None:
    """Motion that is 30 times the noise below 2.5 Hz, more than half of the lines that are looked at."""
    bands, rng = bands_of(RATE_HZ), np.random.default_rng(4)
    n = 60 * bands.samples
    lines = np.fft.rfft(rng.standard_normal((3, n)))
    lines[:, np.fft.rfftfreq(n, 1.0 / RATE_HZ) > 2.5] = 0.0
    moved = 30.0 * np.fft.irfft(lines, n) + 0.01 * rng.standard_normal((3, n))
    assert noise_floor(minutes(moved, bands)[1], bands) == pytest.approx(np.full(3, 1e-4 * 2.0 / RATE_HZ), rel=0.15)


def test_power_along_other_axes_is_that_of_the_turned_outputs() -> None:
    bands, rng = bands_of(RATE_HZ), np.random.default_rng(5)
    x = rng.standard_normal((3, bands.samples))
    assert turned(segment_of(x, bands, np.eye(3)).power, MIXED) == pytest.approx(
        segment_of(MIXED @ x, bands, np.eye(3)).power, rel=1e-9
    )
