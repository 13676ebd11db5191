"""White noise of a reference in the bands of a window: behind filters, of a velocity, in integrals.

The noise is drawn and passes what it would pass; its power in each band is measured, and compared with what is told.
"""

from __future__ import annotations

import numpy as np
import pytest

from calib.excitation.disturbance import against_noise
from calib.excitation.windows import Points
from calib.model import Array, BandSums
from calib.signal.corner import integral, integral_of_motion, without_corner
from calib.windows.banded import Factors
from calib.windows.bands import band_sums, beside_reference_noise, without_noise

RATE_HZ = 200.0


def within(random: np.random.Generator, band_hz: tuple[float, float], n: int, m: int = 3, rms: float = 1.0) -> Array:
    """(n, m) noise in a band alone."""
    lines = np.fft.rfft(random.standard_normal((n, m)), axis=0)
    hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    lines[(hz < band_hz[0]) | (hz > band_hz[1])] = 0.0
    found = np.fft.irfft(lines, n, axis=0)
    return np.asarray(rms * found / found.std(axis=0))


def rate_of(u: Array) -> Array:
    """The derivative of u (n, m), by its spectrum."""
    hz = np.fft.rfftfreq(len(u), 1.0 / RATE_HZ)
    return np.fft.irfft(2j * np.pi * hz[:, None] * np.fft.rfft(u, axis=0), len(u), axis=0)


def bands_of(u: Array, V: Array) -> BandSums:
    found = band_sums(u, rate_of(u), V, RATE_HZ)
    assert found is not None
    return found


@pytest.mark.parametrize("derivatives", [0, 1, 2])
def test_noise_of_a_quantity_that_was_differentiated_is_told_band_by_band(derivatives: int) -> None:
    """Noise of a velocity grows with the frequency in u, and that of a displacement with its square."""
    n, end_hz, random = 120_000, 40.0, np.random.default_rng(1)
    noise = within(random, (0.0, end_hz), n)
    for _ in range(derivatives):
        noise = rate_of(noise)
    measured = bands_of(noise, noise)
    told = beside_reference_noise(measured, np.array([noise.std(axis=0), rate_of(noise).std(axis=0)]), n, derivatives)
    inside = (told.high_hz < 0.99 * end_hz) & (told.low_hz > 2.0)
    assert inside.sum() > 15
    of = told.products.diagonal(axis1=1, axis2=2)[inside, :6]
    chance = np.sqrt(2.0 / measured.points[inside, None])
    z = (of / told.noise[inside, :6] - 1.0) / chance
    assert np.abs(z).max() < 5.0
    assert not told.noise[told.low_hz > end_hz, :6].any()


def test_noise_behind_the_filter_against_a_loud_band_is_told_band_by_band() -> None:
    """The sensor rattles from 5 to 9 Hz beside motion from 2 to 20 Hz: the filter passes a part of these bands alone.
    The noise that the filter leaves is measured by passing it through the filter."""
    n, random = 60_000, np.random.default_rng(2)
    motion, noise = within(random, (2.0, 20.0), n), 1e-2 * random.standard_normal((n, 3))
    rattle = within(random, (5.0, 9.0), n, rms=3.0)
    u, V, time_s = motion + noise, motion + rattle, np.arange(n) / RATE_HZ
    rms = np.array([noise.std(axis=0), rate_of(noise).std(axis=0)])
    made = against_noise(Points(time_s, V, u, rate_of(u)), rms, knocked=False)
    assert made is not None
    left = made.passed(np.column_stack([noise, rate_of(noise), noise]))
    left = left[np.isfinite(left).all(axis=1)]
    measured = band_sums(left[:, :3], left[:, 3:6], left[:, 6:], RATE_HZ)
    assert measured is not None
    told = made.left_in(beside_reference_noise(measured, made.before(rms * made.noise_left), len(left)))
    kept = (told.low_hz > 2.5) & (told.high_hz < 18.0)
    assert kept.sum() > 10
    assert told.noise[kept, 0].max() > 20.0 * (told.noise[kept, 0] / told.points[kept]).min() * told.points[kept].min()
    of = told.products.diagonal(axis1=1, axis2=2)[kept, :6]
    np.testing.assert_allclose(of.sum(axis=0), told.noise[kept, :6].sum(axis=0), rtol=0.05)
    np.testing.assert_allclose(of / told.noise[kept, :6], 1.0, atol=0.5)


def test_noise_of_an_ac_coupled_reference_makes_no_slope_smaller() -> None:
    """In each band the noise is 0.9 % of the motion's power. Slopes without the correction are 0.9 % smaller; so are
    those of a regression on the derivative of the integral, which is the channel itself with all of its noise."""
    n, random = 600_000, np.random.default_rng(3)
    motion = within(random, (1.5, 24.0), n, 1)
    noise = within(random, (0.0, 30.0), n, 1, np.sqrt(0.009 * 30.0 / 22.5))
    x = motion + noise
    u = np.hstack([x, integral(x, RATE_HZ)])
    V = np.repeat(motion, 3, axis=1) + 0.02 * random.standard_normal((n, 3))
    rms = np.array([noise.std(axis=0), rate_of(noise).std(axis=0)])
    bands = without_noise(beside_reference_noise(bands_of(u, V), rms, n))
    inside = np.flatnonzero((bands.low_hz > 1.6) & (bands.high_hz < 23.0))
    assert inside.size > 15
    factors = Factors(bands, inside)
    assert factors.root.shape[1:] == (2, 4)  # integrals are no regressors
    b = np.linalg.solve(factors.root[..., [0, 2]], factors.slopes)[:, 0, 0]
    weight = bands.points[inside]
    assert abs(weight @ b / weight.sum() - 1.0) < 1.5e-3
    # The effect of a channel's integral on the slopes is that of a derivative: 2 pi / omega^2 of it, the other way.
    of_integral = np.linalg.solve(factors.root[..., [0, 2]], factors.root[..., 1:2])[:, 1, 0]
    np.testing.assert_allclose(of_integral, -2.0 * np.pi / factors.omega**2, rtol=1e-3, atol=2e-5)


def test_noise_slower_than_the_motion_does_not_pull_the_corner() -> None:
    """Motion from 3 to 5 Hz beside noise of 5 % of its density, a corner of 0.05 Hz that is known exactly: what is
    left of it is 0. The integral of all that the reference shows has more noise than motion, and this noise goes with
    that of the corrected signal."""
    corner_hz, n = 0.05, 12_000
    left, without = list[float](), list[float]()
    for seed in range(40):
        random = np.random.default_rng(seed)
        motion = within(random, (3.0, 5.0), n, 1)
        hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)[1:, None]
        lines = np.fft.rfft(motion, axis=0)
        lines[1:] *= 1.0 / (1.0 + corner_hz / (1j * hz))
        x = np.fft.irfft(lines, n, axis=0) + within(random, (0.0, 6.0), n, 1, np.sqrt(0.003 * 6.0 / 2.0))
        V = motion + 0.01 * random.standard_normal((n, 1))
        for found, whole in ((left, integral_of_motion(x, RATE_HZ)), (without, integral(x, RATE_HZ))):
            rows = np.hstack([np.ones((n, 1)), without_corner(x, RATE_HZ, corner_hz), whole])
            found.append(float(np.linalg.lstsq(rows, V, rcond=None)[0][2, 0]))
    u = np.std(left) / np.sqrt(len(left))
    assert abs(np.mean(left)) < 3.0 * u
    assert np.mean(without) < -3.0 * u  # of the integral of all that the reference shows


def test_the_integral_of_motion_is_the_integral_where_the_motion_is() -> None:
    """Within 0.1 % of the motion's integral, also near the ends; and all of it where the motion is a few cycles."""
    n, time_s = 12_000, np.arange(12_000) / RATE_HZ
    fast, slow = (np.sin(2.0 * np.pi * hz * time_s + 0.3)[:, None] for hz in (3.1, 0.1))
    exact = -np.cos(2.0 * np.pi * 3.1 * time_s + 0.3)[:, None] / 3.1
    left = integral_of_motion(fast, RATE_HZ) - exact
    assert np.std(left) < 1e-2 * np.std(exact)
    np.testing.assert_array_equal(integral_of_motion(slow, RATE_HZ), integral(slow, RATE_HZ))
    holes = fast.copy()
    holes[5000] = np.nan
    assert np.isnan(integral_of_motion(holes, RATE_HZ)).sum() == 1
    assert n == len(left)
