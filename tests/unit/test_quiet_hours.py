"""Motion of many frequencies looks like noise of the reference; the quietest windows of a day tell the noise."""

from __future__ import annotations

import numpy as np
import pytest

from agent.core.quiet_hours import HOURS, QuietHours
from calib.excitation.front_end import Settings, aligned
from calib.model import Array
from calib.signal.instrument import Instrument
from calib.signal.samples import Samples
from calib.signal.stamps import clock_from_stamps

RATE_HZ, POINTS = 200.0, 12_400
SPAN_S = 1.0, 61.0
OWN_MPS2, SENSOR_MPS2 = 5e-4, 3e-3
DENSITY = OWN_MPS2 / np.sqrt(0.5 * RATE_HZ)
TO_HZ = 7.4


def moved(seed: int, train_mps2: float) -> tuple[Array, Array]:
    """Reference and sensor (n, 3): wind on modes from 2 to 6 Hz, and a train of all frequencies. The sensor has a
    filter above 6 Hz, so that it shows nothing of what looks like noise of the reference."""
    random = np.random.default_rng([63, seed])
    at_hz = np.fft.rfftfreq(POINTS, 1.0 / RATE_HZ)

    def band(low_hz: float, high_hz: float) -> Array:
        lines = np.fft.rfft(random.standard_normal((POINTS, 3)), axis=0)
        lines[(at_hz < low_hz) | (at_hz > high_hz)] = 0.0
        motion = np.fft.irfft(lines, POINTS, axis=0)
        return np.asarray(motion / motion.std())

    low, high = 2e-3 * band(2.0, 6.0) + train_mps2 * band(2.0, 6.0), train_mps2 * band(6.0, 98.0)
    u = low + high + OWN_MPS2 * random.standard_normal(low.shape)
    return u, low + SENSOR_MPS2 * random.standard_normal(low.shape)


def samples(values: Array, device: str) -> Samples:
    return Samples(device, 0, values, clock_from_stamps(np.arange(POINTS) / RATE_HZ))


def noise_in(u: Array, V: Array, most_noise: tuple[float, ...]) -> Array:
    """(3,) the rms of the reference's noise in the band of the motion, as the front end takes it."""
    settings = Settings(to_hz=TO_HZ, most_noise=most_noise)
    found = aligned(samples(V, "s"), samples(u, "r"), Instrument(), SPAN_S, settings=settings)
    assert found is not None
    return found.reference_noise[0]


def test_a_train_does_not_become_noise_of_the_reference() -> None:
    """By itself, its window has eight times the noise."""
    hours = QuietHours()
    hours.update("r", 3.0, moved(0, 0.0)[0], RATE_HZ)
    u, V = moved(1, 0.05)
    hours.update("r", 3.1, u, RATE_HZ)
    most_noise = hours.most_noise("r")
    np.testing.assert_allclose(most_noise, DENSITY, rtol=0.05)
    true = noise_in(*moved(0, 0.0), ())
    alone, beside = noise_in(u, V, ()), noise_in(u, V, most_noise)
    assert (alone > 7.0 * true).all()
    np.testing.assert_allclose(beside, true, rtol=0.06)


def test_a_quiet_window_keeps_the_noise_that_it_shows_itself() -> None:
    """The quietest of many windows seems less noisy than it is, by chance."""
    u, V = moved(2, 0.0)
    least = tuple(np.full(3, 0.95 * DENSITY).tolist())
    np.testing.assert_array_equal(noise_in(u, V, least), noise_in(u, V, ()))


def test_more_noise_counts_after_a_day_and_that_of_another_device_at_once() -> None:
    hours, still = QuietHours(), moved(3, 0.0)[0]
    hours.update("r", 0.5, still, RATE_HZ)
    for hour in range(1, HOURS + 1):
        np.testing.assert_allclose(hours.most_noise("r"), DENSITY, rtol=0.05)
        hours.update("r", 0.5 + hour / 24.0 + 1e-3, 3.0 * still, RATE_HZ)
    np.testing.assert_allclose(hours.most_noise("r"), 3.0 * DENSITY, rtol=0.05)
    for hour in range(HOURS):  # another sensor beside it, whose days begin anew
        hours.update("r", hour / 24.0 - 2.0 + 1e-3, 9.0 * still, RATE_HZ)
    np.testing.assert_allclose(hours.most_noise("r"), 9.0 * DENSITY, rtol=0.05)
    hours.forget("r")
    assert hours.most_noise("r") == ()


def test_a_reference_that_rests_in_one_digit_rounds_where_it_moves() -> None:
    digit, hours = 0.01, QuietHours()
    u = np.round(moved(4, 0.0)[0] / digit) * digit
    u[::1000] += digit
    hours.update("r", 0.0, u, RATE_HZ)
    assert min(hours.most_noise("r")) >= 0.999 * digit / np.sqrt(12.0) / np.sqrt(0.5 * RATE_HZ)


@pytest.mark.parametrize("values", [np.zeros((POINTS, 3)), np.full((POINTS, 3), np.nan), moved(5, 0.0)[0][:100]])
def test_what_tells_no_noise_is_not_taken_for_none(values: Array) -> None:
    hours = QuietHours()
    hours.update("r", 0.0, values, RATE_HZ)
    assert hours.most_noise("r") == ()


def test_a_snapshot_goes_on_bit_for_bit() -> None:
    hours = QuietHours()
    for k in range(3):
        hours.update("r", k / 10.0, moved(6 + k, 0.0)[0], RATE_HZ)
    other = QuietHours()
    other.load(hours.snapshot())
    for each in (hours, other):
        each.update("r", 1.02, moved(9, 0.0)[0], RATE_HZ)
    assert other.most_noise("r") == hours.most_noise("r")
    np.testing.assert_equal(other.snapshot(), hours.snapshot())
