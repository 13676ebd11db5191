"""The peak frequency of an hour: against modes of known frequency, beside noise, at the edge of a band, turned axes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from calib.model import Array
from calib.signal.spectra import Bands, bands_of, noise_floor, peak_frequency, segment_of

RATE_HZ, DAMPING, MINUTES = 20.0, 0.01, 60
AXES = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def motion(hz: float, seed: int, minutes: int = MINUTES) -> Array:
    """A mode of standard deviation 1 that is moved by white noise."""
    n, w = int(60 * RATE_HZ * minutes), 2.0 * np.pi * hz / RATE_HZ
    r = np.exp(-DAMPING * w)
    x = lfilter([1.0, -1.0], [1.0, -2.0 * r * np.cos(w), r * r], np.random.default_rng(seed).standard_normal(n))
    return np.asarray(x / x.std())


def hour(x: Array, bands: Bands, by: Array = AXES) -> tuple[Array, Array]:
    made = [segment_of(part, bands, by) for part in np.split(x, x.shape[1] // bands.samples, axis=1)]
    floor = noise_floor(np.array([one.floor for one in made]), bands)
    return peak_frequency(np.array([one.peaks for one in made]), floor, bands)


def beside(hz: float, noise: tuple[float, float, float], seed: int) -> tuple[Array, Array]:
    """Peak frequencies of an hour of one mode in x, y, z beside noise of these standard deviations."""
    x = motion(hz, seed)
    rng = np.random.default_rng([seed, 1])
    return hour(x + np.array(noise)[:, None] * rng.standard_normal((3, len(x))), bands_of(RATE_HZ))


@pytest.mark.parametrize("hz", [1.12, 2.0, 2.24])
def test_a_mode_is_found_where_it_is_also_at_the_edge_of_a_band(hz: float) -> None:
    """1.12 and 2.24 Hz are edges: both windows show the mode within 0.6 %, and a fall by 2 % within 3 u."""
    bands = bands_of(RATE_HZ)
    near = np.flatnonzero(np.abs(np.log10(bands.centre_hz / hz)) < 0.055)
    (before, u), (after, u_after) = beside(hz, (0.02,) * 3, 1), beside(0.98 * hz, (0.02,) * 3, 1)
    assert before[:, near] == pytest.approx(np.full((3, len(near)), hz), rel=6e-3)
    apart = np.abs(np.log(after / before) - np.log(0.98))[:, near]
    assert (apart < 3.0 * np.hypot(u, u_after)[:, near] / hz).all()
    assert apart.max() < 0.005


@pytest.mark.slow
def test_the_stated_uncertainty_is_the_scatter_of_hours() -> None:
    """40 times 30 minutes, seeds 0 to 39: the ratio of squares is chi-squared over its 39 degrees of freedom, 0.44 to
    1.9 at 99.9 %."""
    bands = bands_of(RATE_HZ)
    at = int(np.argmin(np.abs(bands.centre_hz - 2.0)))
    told = [hour(np.array([motion(2.0, seed, 30)] * 3), bands) for seed in range(40)]
    found, u = (np.array([each[k][0, at] for each in told]) for k in (0, 1))
    assert 0.44 < found.var(ddof=1) / np.mean(u**2) < 1.9
    # At least the bound of a mode, f sqrt(z / (4 pi f T)); the square of lines and windows of a minute cost a factor.
    bound = 2.0 * np.sqrt(DAMPING / (4.0 * np.pi * 2.0 * 1800.0))
    assert 1.0 < np.sqrt(np.mean(u**2)) / bound < 4.0


@pytest.mark.slow
def test_a_floor_that_doubles_moves_nothing() -> None:
    """White noise of 1.5 times the motion, and twice its power: four hours within 0.3 %, each within 3 u."""
    bands = bands_of(RATE_HZ)
    near = np.flatnonzero(np.abs(np.log10(bands.centre_hz / 2.3)) < 0.07)
    shift, both = [], []
    for seed in range(4):
        (quiet, u), (loud, u_loud) = (beside(2.3, (noise,) * 3, seed) for noise in (1.5, 1.5 * 2.0**0.5))
        shift.append((loud / quiet - 1.0)[:, near])
        both.append(np.hypot(u, u_loud)[:, near] / 2.3)
    assert len(near) == 2
    assert np.abs(np.mean(shift, axis=0)).max() < 3e-3
    assert (np.abs(shift) < 3.0 * np.array(both)).all()


def test_noise_alone_has_no_peak() -> None:
    bands = bands_of(RATE_HZ)
    frequency, u = hour(np.random.default_rng(3).standard_normal((3, MINUTES * bands.samples)), bands)
    assert np.isnan(frequency).mean() > 0.95
    assert (np.isnan(u) == np.isnan(frequency)).all()


def test_peaks_are_along_the_axes_that_are_asked_for() -> None:
    bands = bands_of(RATE_HZ)
    x = np.array([motion(1.0, 1), motion(4.0, 2), 0.01 * np.ones(MINUTES * bands.samples)])
    swapped = np.array([[0.0, 1.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for at, axis in ((1.0, 1), (4.0, 0)):
        band = int(np.argmin(np.abs(bands.centre_hz - at)))
        assert hour(x, bands, swapped)[0][axis, band] == pytest.approx(at, rel=5e-3)


def test_a_lorry_that_shakes_otherwise_counts_as_one_minute() -> None:
    """One minute in which another mode of the window is 30 times as strong moves the hour by its share."""
    bands = bands_of(RATE_HZ)
    at = int(np.argmin(np.abs(bands.centre_hz - 2.0)))
    x = motion(2.0, 1)
    quiet = hour(np.array([x] * 3), bands)[0][0, at]
    x[: bands.samples] += 30.0 * motion(2.2, 2)[: bands.samples]
    assert abs(hour(np.array([x] * 3), bands)[0][0, at] / quiet - 1.0) < 2.5 * 0.1 / MINUTES
