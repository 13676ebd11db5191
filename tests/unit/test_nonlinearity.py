"""A sensor whose output is not proportional to the motion: one that slips where the motion is strong."""

from __future__ import annotations

import numpy as np
import pytest

from calib.excitation.detection import knocked, least_step
from calib.excitation.steadiness import nonlinearity
from calib.excitation.windows import Points, motion_windows
from calib.geometry import along
from calib.model import Array, Window

RATE_HZ, SECONDS, NOISE = 100.0, 60, 0.01
NOWHERE = along([1.0, 0.0, 0.0])


def random_motion(seed: int) -> Array:
    """(n,) Gaussian, from 1 to 12 Hz, 1 m/s2 rms."""
    random, n = np.random.default_rng(seed), round(RATE_HZ * SECONDS)
    lines, frequency_hz = np.fft.rfft(random.normal(size=n)), np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    u = np.fft.irfft(np.where((frequency_hz > 1.0) & (frequency_hz < 12.0), lines, 0.0), n)
    return np.asarray(u / u.std())


def output(felt: Array, seed: int) -> Array:
    """(n, 3) of a sensor of three axes that feels `felt` along x, and a little of it along y and z."""
    noise = NOISE * np.random.default_rng([seed, 1]).normal(size=(len(felt), 3))
    return np.asarray(felt[:, None] * np.array([1.0, 0.02, -0.01]) + noise)


def window(u: Array, V: Array) -> Window:
    t = np.arange(len(u)) / RATE_HZ
    (found,) = motion_windows(NOWHERE, Points(t, V, u[:, None], np.gradient(u, t)[:, None]))
    return found


@pytest.mark.parametrize("above", [1.5, 1.75, 2.0])
def test_a_sensor_that_slips_where_the_motion_is_strong_is_refused(above: float) -> None:
    """Held by friction, it feels no more than `above` m/s2. As knocks, most slips were left out; S was too small."""
    u = random_motion(1)
    found = window(u, output(np.clip(u, -above, above), 1))
    assert not found.used
    assert found.reason.startswith(
        "the output is not proportional to the motion: where the motion is strongest, the sens"
    )
    assert found.numbers["nonlinearity_pct"] > found.numbers["nonlinearity_pct_threshold"]
    assert window(u, output(u, 1)).used


@pytest.mark.slow
def test_slips_do_not_hide_in_noise_nor_make_themselves_uncertain() -> None:
    """50 seeds of 20 s, noise a tenth of the motion, slips above twice its rms: all are refused. The strong points
    scatter by their slips; how uncertain their sensitivity is, the moderate points tell."""
    seconds = slice(0, round(20 * RATE_HZ))
    for seed in range(50):
        u = random_motion(seed)[seconds]
        noise = 0.1 * np.random.default_rng([seed, 2]).normal(size=(len(u), 3))
        slipping, sound = (window(u, output(felt, seed) + noise) for felt in (np.clip(u, -2.0, 2.0), u))
        assert not slipping.used
        assert slipping.reason.startswith("the output is not proportional to the motion")
        assert sound.used


def test_an_output_that_rises_more_than_the_motion_is_refused_as_well() -> None:
    u = random_motion(2)
    found = window(u, output(u + 0.02 * u**3, 2))
    assert not found.used
    assert found.numbers["nonlinearity_pct"] > found.numbers["nonlinearity_pct_threshold"]


@pytest.mark.slow
def test_the_uncertainty_is_that_of_proportional_outputs() -> None:
    """200 seeds: the rms of value over u is 1 within a quarter, and no window comes near its limit."""
    found = []
    for seed in range(200):
        u = random_motion(seed)
        V = output(u, seed)
        basis = np.column_stack([np.ones(len(u)), u])
        found.append(nonlinearity(V, knocked(V, basis, least_step(V))[1], RATE_HZ))
    value, uncertainty = (np.array([f[name] for f in found]) for name in ("nonlinearity_pct", "u_nonlinearity_pct"))
    assert 0.75 < np.sqrt(np.mean((value / uncertainty) ** 2)) < 1.25
    assert np.abs(value).max() < 0.5


@pytest.mark.parametrize("noise", [0.02, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("shape", ["sine", "square", "random"])
def test_noise_of_the_reference_is_no_slip(noise: float, shape: str) -> None:
    """The strongest values of a noisy reference are those to which its noise adds: the sensor shows less there."""
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    sine = np.sqrt(2.0) * np.sin(2.0 * np.pi * 2.03 * t)
    u = {"sine": sine, "square": np.sign(sine), "random": random_motion(3)}[shape]
    noisy = u + noise * np.random.default_rng(4).normal(size=len(u))
    assert window(noisy, output(u, 3)).used
