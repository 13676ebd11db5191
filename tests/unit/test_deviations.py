"""Deviations of bands: noise that comes with the motion is none, another response is."""

from __future__ import annotations

from functools import reduce

import numpy as np
import pytest

from calib.distributions import chi2_quantile
from calib.estimate.deviations import PROBABILITY, Deviations
from calib.estimate.record import Record
from calib.excitation.bands import band_sums, beside_noise
from calib.excitation.sums import window_sums
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import Pose, Window

RATE_HZ, WINDOW_S, BAND_HZ = 200.0, 60, (0.5, 12.0)
POSE = Pose("beside", np.eye(3), np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2]))


def of_lorries(random: np.random.Generator, narrow: float = 0.0) -> Record:
    """A minute in which lorries make motion and noise of the sensor 1.6 times as strong, three times for two seconds.

    `narrow`: by how much more the sensor shows of the motion between 4 and 5 Hz.
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
    V = np.fft.irfft(lines, n) + 5e-4 * strong * random.standard_normal((3, n))
    bands = beside_noise(band_sums(u.T, du.T, V.T, RATE_HZ), np.full(3, np.inf))
    sums = window_sums(u.T, du.T, V.T, np.linspace(0, n, WINDOW_S + 1).astype(int))
    return Record.of(Window(0.0, WINDOW_S, POSE, sums, True, "", n, 0, bands=bands), 0.0)


def together(records: int, seed: int, narrow: float = 0.0) -> Deviations:
    random = np.random.default_rng(seed)
    return reduce(Deviations.plus, (of_lorries(random, narrow).deviations for _ in range(records)))


@pytest.mark.parametrize("seed", [1, 3])
def test_noise_that_comes_with_the_motion_is_no_other_response(seed: int) -> None:
    """The slopes of bands scatter more than in steady noise, and with 20 windows chance does not explain that."""
    found = together(20, seed)
    assert found.square > chi2_quantile(PROBABILITY, found.freedom)  # else the test shows nothing
    assert found.between.scatter == 0.0


def test_a_narrow_feature_of_the_response_is_found_in_this_noise() -> None:
    found = together(4, 1, narrow=0.05).between
    assert 4.0 < found.at_hz < 5.1
    assert 0.003 < found.relative_u < 0.03
