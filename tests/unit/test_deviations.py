"""Deviations of bands: noise that comes with the motion is none, another response is."""

from __future__ import annotations

from functools import reduce

import numpy as np
import pytest

from calib.distributions import chi2_quantile
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import Pose, Window
from calib.windows.bands import band_sums, beside_noise
from calib.windows.deviations import PROBABILITY, BetweenBands, Deviations, LeftOpen
from calib.windows.record import Record
from calib.windows.sums import window_sums

RATE_HZ, WINDOW_S, BAND_HZ = 200.0, 60, (0.5, 12.0)
POSE = Pose("beside", np.eye(3), np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2]))


def of_lorries(random: np.random.Generator, narrow: float = 0.0, noise_mps2: float = 5e-4) -> Record:
    """A minute in which lorries make motion and noise of the sensor 1.6 times as strong, three times for two seconds.

    `narrow`: by how much more the sensor shows of the motion between 4 and 5 Hz. `noise_mps2`: that of the sensor.
    """
    n = round(RATE_HZ * WINDOW_S)
    time_s, frequency_hz = np.arange(n) / RATE_HZ, np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    lines = np.fft.rfft(random.standard_normal((3, n)))
    lines[:, (frequency_hz < BAND_HZ[0]) | (frequency_hz > BAND_HZ[1])] = 0.0
    begins_s = random.uniform(0.0, WINDOW_S - 2.0, 3)
    strong = 1.0 + 0.6 * np.exp(-0.5 * ((time_s - 1.0 - begins_s[:, None]) / 0.5) ** 2).sum(axis=0)
    u = 0.02 * np.fft.irfft(lines, n) * strong
    du = np.gradient(u, 1.0 / RATE_HZ, axis=1)
    lines = np.fft.rfft(u)
    lines[:, (frequency_hz > 4.0) & (frequency_hz < 5.0)] *= 1.0 + narrow
    V = np.fft.irfft(lines, n) + noise_mps2 * strong * random.standard_normal((3, n))
    plain = band_sums(u.T, du.T, V.T, RATE_HZ)
    assert plain is not None
    bands = beside_noise(plain, np.full(3, np.inf))
    sums = window_sums(u.T, du.T, V.T, np.linspace(0, n, WINDOW_S + 1).astype(int))
    return Record.of(Window(0.0, WINDOW_S, POSE, sums, True, "", n, 0, bands=bands), 0.0)


def together(records: int, seed: int, narrow: float = 0.0) -> Deviations:
    random = np.random.default_rng(seed)
    return reduce(Deviations.plus, (of_lorries(random, narrow).deviations for _ in range(records)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_noise_that_comes_with_the_motion_is_no_other_response(seed: int) -> None:
    """The slopes of bands scatter more than in steady noise, and with 20 windows chance does not explain that."""
    found = together(20, seed)
    assert found.square > chi2_quantile(PROBABILITY, found.freedom)  # else the test shows nothing
    assert found.between.scatter == 0.0


def test_rows_weigh_less_only_where_they_scatter_more_than_their_noise() -> None:
    """In one of 100 cases noise alone shows 1.2 times the quantile of chi-squared, which is 37.6 for 20 rows."""
    assert Deviations().times_noise == 1.0
    assert Deviations(freedom=20.0, square=45.0).times_noise == 1.0
    assert Deviations(freedom=20.0, square=46.0).times_noise == 2.3


def test_a_narrow_feature_of_the_response_is_found_in_this_noise() -> None:
    found = together(4, 1, narrow=0.05).between
    assert 4.0 < found.at_hz < 5.1
    assert 0.003 < found.relative_u < 0.03


@pytest.mark.one_case
@pytest.mark.parametrize("seed", range(4))
def test_noise_as_strong_as_the_motion_is_no_other_response(seed: int) -> None:
    """The noise of a band is in its slopes: what they leave must not be multiplied by it. Over 60 such windows the
    product had a mean that looked like a deviation of 10 % (48 standard uncertainties)."""
    random = np.random.default_rng([37, seed])
    found = reduce(Deviations.plus, (of_lorries(random, noise_mps2=0.02).deviations for _ in range(60)))
    assert abs(found.moved) < 3.0 * np.sqrt(found.variance)
    assert found.between.shift == 0.0


def left_open(shares: tuple[float, float, float], u: float = 0.0, total: float = 1.0) -> LeftOpen:
    """Nine thirds of an octave about 1 Hz, in which the rest has these shares of the power of each axis, beside white
    noise whose variance is known to `u` of it. Of x so much is shown, of the others 1."""
    shown = np.array([total, 1.0, 1.0])
    own = (*shown.tolist(), *(shown * shares).tolist(), *((shown * u) ** 2).tolist())
    return LeftOpen(tuple((k, own) for k in range(-4, 5)))


def test_noise_that_may_be_the_references_is_an_error_between_0_and_its_share() -> None:
    """All as likely: u is the half width over the root of 3, of an error that is not corrected the whole over it."""
    found = left_open((0.01, 0.02, 0.0))
    assert found.lost(1.0) == pytest.approx(0.02, rel=1e-12)
    assert found.u_lost(1.0) == pytest.approx(0.02 / 1.7320508, rel=1e-6)


@pytest.mark.parametrize(("share", "lost"), [(0.011, 0.0), (0.0146, 0.0146)])
def test_noise_that_chance_explains_is_not_the_references(share: float, lost: float) -> None:
    """Within an octave are seven bands. The SD of the median of so many normal values is sqrt(pi / 2 / 7) of that of
    one: three of them are 1.42 u."""
    assert left_open((share, share, share), 0.01).lost(1.0) == pytest.approx(lost, rel=1e-12)


@pytest.mark.parametrize(("total", "lost"), [(0.09, 0.01), (0.11, 0.02)])
def test_an_axis_that_moved_less_than_a_tenth_says_nothing_of_the_reference(total: float, lost: float) -> None:
    assert left_open((0.02, 0.01, 0.01), total=total).lost(1.0) == pytest.approx(lost, rel=1e-12)


def test_what_axes_explain_is_neither_a_gain_nor_a_lag() -> None:
    """Two bands, at 1 and 2 Hz, with half of the power each. Of -c2 omega^2 a gain leaves half of the difference; of
    -i c3 omega^3 a lag, by weighted least squares, omega (omega^2 - 17/5 of that at 1 Hz). Corners 1 % off change c_k
    by k %; in 5 of 100 cases the sum of squares of three axes about their mean is more than 5.99 of one's variance."""
    c2, c3, one = 2e-4, -5e-5, 2.0 * np.pi
    bands = ((0, (1.0, 0.0, 0.0, *[0.0] * 6)), (3, (0.5, 0.5, 0.0, *[0.0] * 6)))
    at = [-(one**2), 0.0, one**4, 0.0, -(one**6)]
    found = LeftOpen(bands, (-(one**2) * 5.0, 0.0, 0.0, 0.0, 0.0)).by_axis(
        np.array([c2, c3, 0.0, 0.0, 0.0]), np.array(at)
    )
    of_gain = 2.0 * c2 * one**2 * 1.5
    of_lag = 3.0 * c3 * one**3 * np.array([1.0 - 3.4, 2.0 * (4.0 - 3.4)])
    expected = 0.01 * np.sqrt(5.9915 / 3.0 * (of_gain**2 + 0.5 * np.sum(of_lag**2)))
    assert found.explains == pytest.approx(expected, rel=1e-4)
    assert found.u == pytest.approx(0.01 * 2.0 * c2 * one**2 * 1.5, rel=1e-9)  # the mean effect is that of 2.5 at 1 Hz


def test_deviations_count_as_far_as_nothing_explains_them() -> None:
    found = BetweenBands(scatter=0.05, shift=0.02)
    assert found.beyond(0.03) == pytest.approx(0.04, rel=1e-12)
    assert found.beyond(0.06) == 0.02
