"""Resampling and differentiation against sines known at any time."""

from __future__ import annotations

import numpy as np
import pytest

from calib.signal.band import noise_in_bands
from calib.signal.resampling import differentiate, differentiated_band_hz, resample
from calib.signal.stamps import clock_from_stamps

RATE_HZ = 1000.0
t_ref = 0.0123 + np.arange(5000) / RATE_HZ
CLOCK = clock_from_stamps(t_ref)
t_sensor = np.arange(0.0, 5.2, 1 / 1013.0)


@pytest.mark.parametrize("frequency_hz", [0.2, 3.0, 8.0, 50.0, 200.0, 250.0])
def test_value_and_derivative(frequency_hz: float) -> None:
    omega = 2 * np.pi * frequency_hz
    out = resample(np.sin(omega * t_ref + 0.3)[:, None], CLOCK, t_sensor)
    t = t_sensor[out.usable]
    assert np.abs(out.u[out.usable, 0] - np.sin(omega * t + 0.3)).max() < 1e-5
    assert np.abs(out.du[out.usable, 0] - omega * np.cos(omega * t + 0.3)).max() < 1e-4 * omega


def test_channels_do_not_mix_and_cubics_are_exact() -> None:
    x = np.column_stack([np.ones_like(t_ref), t_ref, t_ref**3])
    out = resample(x, CLOCK, t_sensor)
    t = t_sensor[out.usable]
    np.testing.assert_allclose(out.u[out.usable], np.column_stack([np.ones_like(t), t, t**3]), rtol=0, atol=1e-9)
    np.testing.assert_allclose(out.du[out.usable], np.column_stack([0 * t, t**0, 3 * t**2]), rtol=0, atol=1e-6)


def test_edges_without_support_are_marked() -> None:
    out = resample(np.zeros((5000, 1)), CLOCK, t_sensor)
    inside = (t_sensor > t_ref[8]) & (t_sensor < t_ref[-9])
    assert out.usable[inside].all()
    assert not out.usable[(t_sensor < t_ref[6]) | (t_sensor > t_ref[-7])].any()
    assert (out.u[~out.usable] == 0).all()


def test_part_of_a_recording_is_the_same_as_the_whole() -> None:
    x = np.sin(2 * np.pi * 7 * t_ref)[:, None]
    t = np.arange(2.0, 3.0, 1 / 1013.0)
    whole, part = resample(x, CLOCK, t), resample(x[1500:3500], CLOCK, t, first_index=1500)
    assert part.usable.all()
    np.testing.assert_allclose(part.u, whole.u, rtol=0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("after", [0.0, 0.25, 0.5, None])
def test_white_noise_has_the_power_that_its_bands_tell(after: float | None) -> None:
    """At the samples of the reference u has all of it, halfway between them 14 % less; `after` None: everywhere between
    them. 200 channels of 4900 points know a power to 0.2 %."""
    x = np.random.default_rng(1).normal(size=(5000, 200))
    t = t_sensor if after is None else t_ref + after / RATE_HZ
    out = resample(x, CLOCK, t)
    density = np.full(200, 1.0 / np.sqrt(0.5 * RATE_HZ))
    told = noise_in_bands(density, out.noise_hz, 0)
    assert np.sqrt(np.mean(out.u[out.usable] ** 2)) == pytest.approx(told[0, 0], rel=4e-3)
    assert np.sqrt(np.mean(out.du[out.usable] ** 2)) == pytest.approx(told[1, 0], rel=4e-3)


def test_nothing_is_interpolated_across_a_gap() -> None:
    kept = np.r_[0:2000, 2100:5000]
    clock = clock_from_stamps(t_ref[kept])
    x = np.sin(2 * np.pi * 5 * t_ref[kept])[:, None]
    out = resample(x, clock, t_sensor)
    in_gap = (t_sensor > t_ref[2000] - 0.008) & (t_sensor < t_ref[2100] + 0.008)
    assert not out.usable[in_gap].any()
    t = t_sensor[out.usable]
    assert np.abs(out.u[out.usable, 0] - np.sin(2 * np.pi * 5 * t)).max() < 1e-5
    assert out.usable.mean() > 0.9


@pytest.mark.parametrize(("rate_hz", "frequency_hz"), [(1000.0, 1.0), (1000.0, 8.0), (1000.0, 50.0), (200.0, 8.0)])
def test_velocity_becomes_acceleration(rate_hz: float, frequency_hz: float) -> None:
    t = np.arange(4000) / rate_hz
    omega = 2 * np.pi * frequency_hz
    acceleration, lost = differentiate(np.sin(omega * t)[:, None] / omega, rate_hz)
    assert lost <= 80
    inner = slice(lost, -lost)
    assert np.abs(acceleration[inner, 0] - np.cos(omega * t[inner])).max() < 1e-4


def test_differentiation_damps_what_is_above_the_band() -> None:
    t = np.arange(4000) / 1000.0
    acceleration, lost = differentiate(np.sin(2 * np.pi * 130 * t)[:, None], 1000.0)
    assert np.abs(acceleration[lost:-lost]).max() < 1e-3 * 2 * np.pi * 130


@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 50.0, 1000.0])
@pytest.mark.parametrize("of_band", [0.02, 0.1, 0.5, 1.0])
def test_displacement_becomes_acceleration(rate_hz: float, of_band: float) -> None:
    t = np.arange(4000) / rate_hz
    omega = 2 * np.pi * of_band * differentiated_band_hz(rate_hz)
    acceleration, lost = differentiate(-np.sin(omega * t)[:, None] / omega**2, rate_hz, 2)
    inner = slice(lost, -lost)
    assert np.abs(acceleration[inner, 0] - np.sin(omega * t[inner])).max() < 5e-5


def test_the_acceleration_of_a_parabola_is_exact_far_from_zero() -> None:
    t = np.arange(4000) / 50.0
    acceleration, lost = differentiate(np.column_stack([100.0 + 3.0 * t, 0.25 * t**2]), 50.0, 2)
    inner = acceleration[lost:-lost]
    np.testing.assert_allclose(inner, np.tile([0.0, 0.5], (len(inner), 1)), rtol=0, atol=1e-8)


def test_a_second_derivative_damps_what_is_above_the_band() -> None:
    t = np.arange(4000) / 1000.0
    acceleration, lost = differentiate(np.sin(2 * np.pi * 110 * t)[:, None], 1000.0, 2)
    assert np.abs(acceleration[lost:-lost]).max() < 3e-6 * (2 * np.pi * 110) ** 2


def test_another_order_is_refused() -> None:
    with pytest.raises(ValueError, match="a derivative of order 3 is not known, only of order 1 and 2"):
        differentiate(np.zeros((4000, 1)), 1000.0, 3)


@pytest.mark.parametrize("time_s", [1e25, -1e25, np.nan])
def test_a_time_whose_number_no_integer_can_be_is_not_usable(time_s: float) -> None:
    assert not resample(np.zeros((5000, 1)), CLOCK, np.full(3, time_s)).usable.any()
