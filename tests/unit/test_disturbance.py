"""Noise that is strong at some frequencies only: it costs these and nothing else, or the data are refused."""

from __future__ import annotations

import numpy as np
import pytest

from calib.estimate.nuisances import Priors
from calib.excitation.detection import incoherent, knocked, least_step
from calib.excitation.disturbance import against_noise, not_more_than_incoherent
from calib.excitation.windows import Points
from calib.recorded.adjusting import adjusted
from calib.recorded.outcome import Outcome
from tests.pair import Disturbance, Pair, flat, hum, noise, pair, rattle, resonance, undisturbed

U_REFERENCE = 1e-3
BAND_HZ = (0.5, 20.0)
DENSITY = 1.0 / np.sqrt(BAND_HZ[1] - BAND_HZ[0])  # of the motion, in m/s2 per root Hz


def made(disturbed: Disturbance, seed: int = 1) -> tuple[Pair, Outcome]:
    found = pair(seed, flat, band_hz=BAND_HZ, rate_hz=200.0, seconds=300.0, disturbed=disturbed)
    stated = Priors(reference=U_REFERENCE, reference_frequency_hz=found.reference_frequency_hz)
    return found, adjusted(found.files, stated)


def errors(disturbed: Disturbance) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    """Errors of S and their standard uncertainties, (3, 3) each."""
    of, found = made(disturbed)
    assert found.calibration is not None, found.reasons
    return found.calibration.sensitivity - of.sensitivity, found.calibration.standard_uncertainty[:9].reshape(3, 3)


def upper_half(frequency_hz: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    return np.where(frequency_hz > 10.0, DENSITY, 0.0)


@pytest.mark.two_cases
@pytest.mark.parametrize(
    ("disturbed", "times"),
    [
        (hum(12.0, 0.3), 1.3),
        (hum(46.0, 0.5), 1.3),
        (rattle(30.0, 0.5), 1.6),
        (noise(upper_half), 1.3),
        (noise(upper_half, of_reference=True), 1.3),
        (noise(lambda f: 0.01 * DENSITY * np.sqrt(3.0 / f)), 1.3),
        (rattle(14.0, 0.3), 3.0),
    ],
    ids=[
        "hum",
        "hum above",
        "rattle above",
        "sensor incoherent",
        "reference incoherent",
        "1/f",
        "rattle in the motion",
    ],
)
def test_a_disturbance_costs_its_band(disturbed: Disturbance, times: float) -> None:
    """u is at most so many times that without the disturbance, and S is right within it."""
    _, clean = errors(undisturbed)
    error, u = errors(disturbed)
    assert np.diag(u).max() < times * np.diag(clean).max()
    assert np.abs(error / u).max() < 3.0


@pytest.mark.thorough
def test_another_response_is_not_taken_for_noise() -> None:
    """A resonance within the motion contradicts one S: it is named, not filtered away."""
    of = pair(3, resonance(8.0, 8.0), band_hz=BAND_HZ, rate_hz=200.0, seconds=300.0)
    found = adjusted(of.files, Priors(reference=U_REFERENCE, reference_frequency_hz=of.reference_frequency_hz))
    assert found.calibration is None


@pytest.mark.two_cases
@pytest.mark.parametrize("to_hz", [30.0, 40.0, 45.0])
@pytest.mark.parametrize("late_s", [0.0, 0.005])
def test_motion_that_fills_the_spectrum_is_not_noise(to_hz: float, late_s: float) -> None:
    """At 100 Hz: the median of such a spectrum is motion. Half a sample apart, interpolation fails above 30 Hz."""
    of = pair(2, flat, band_hz=(0.5, to_hz), rate_hz=100.0, seconds=300.0, reference_late_s=late_s)
    found = adjusted(of.files, Priors(reference=1e-9))
    assert found.calibration is not None, found.reasons
    error = found.calibration.sensitivity - of.sensitivity
    assert np.abs(error).max() < 3e-4
    assert np.abs(error.ravel() / found.calibration.standard_uncertainty[:9]).max() < 4.0


def test_what_the_sensor_does_not_show_is_the_most_that_is_noise() -> None:
    random = np.random.default_rng(5)
    motion, own = random.normal(size=(6000, 3)), 0.2 * random.normal(size=(6000, 3))
    V = np.roll(motion, 3, axis=0) @ (np.eye(3) + 0.1 * random.normal(size=(3, 3)))
    assert incoherent(motion + own, V) == pytest.approx(0.2, rel=0.05)
    assert incoherent(motion, V).max() < 0.05  # three samples of lag leave as little


def test_a_residual_that_grows_with_the_motion_is_no_knock() -> None:
    """A tenth of the motion is in a direction that the reference does not show; knocks are found all the same."""
    random = np.random.default_rng(6)
    level = np.repeat(random.exponential(1.0, 60), 100)
    u = (level[:, None] + 0.05) * random.normal(size=(6000, 3))
    V = u + 0.1 * level[:, None] * random.normal(size=(6000, 3)) + 1e-3 * random.normal(size=(6000, 3))
    hit = random.choice(6000, 20, replace=False)
    V[hit] += 20.0
    struck, _ = knocked(V, np.column_stack([np.ones(6000), u]), least_step(V))
    assert struck[hit].all()
    assert struck.sum() < 20 + 0.01 * 6000


def test_noise_at_the_frequencies_of_the_motion_counts_most() -> None:
    """Slopes of a structure with one mode, beside a band of rattle that the filter takes away: 60 draws of 9 slopes
    scatter by at most what their independent points say, and by no less than 0.6 of it, as variance (standard error 6
    %). By the amplitudes of the filter alone, whatever moves, they scattered 1.6 times as much."""
    random, n, rate_hz = np.random.default_rng(7), 5000, 250.0
    time_s, hz = np.arange(n) / rate_hz, np.fft.rfftfreq(n, 1.0 / rate_hz)
    x = np.maximum(hz, 1e-3) / 1.1
    mode = x**4 / ((1.0 - x**2) ** 2 + (0.04 * x) ** 2) / (1.0 + x**6) + 0.05 * (hz < 40.0)
    loud = np.where((hz > 8.0) & (hz < 30.0), 20.0, 1.0)

    def shaped(amplitude: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        lines = np.fft.rfft(random.standard_normal((n, 3)), axis=0)
        return np.asarray(np.fft.irfft(lines * amplitude[:, None], n, axis=0))

    over = []
    for _ in range(60):
        u = shaped(np.sqrt(mode))
        u *= 0.03 / u.std(axis=0)
        V = u + 0.01 * shaped(loud)
        passes = against_noise(Points(time_s, V, u, np.gradient(u, time_s, axis=0)), np.zeros((2, 3)), knocked=False)
        assert passes is not None
        V, u = (own[~np.isnan(own).any(axis=1)] for own in (passes.passed(V), passes.passed(u)))
        V, u = V - V.mean(axis=0), u - u.mean(axis=0)
        slopes, rest, *_ = np.linalg.lstsq(u, V, rcond=None)
        variance = rest / len(u) / passes.independent(np.inf)
        over.append(np.mean((slopes - np.eye(3)) ** 2 / np.outer(np.diag(np.linalg.inv(u.T @ u)), variance)))
    assert 0.6 < np.mean(over) < 1.15


@pytest.mark.parametrize("derivatives", [0, 2])
def test_the_reference_is_as_noisy_as_what_the_sensor_does_not_show(derivatives: int) -> None:
    """White noise of an acceleration or a displacement, stated five times too large, beside a motion from 2 to 8 Hz:
    half of its power counts, because the other half may be the sensor's. The part of it in each band of 0.8 Hz is that
    at the middle of the band; by the end of the band, 0.79 of that of a displacement would count. The mean of five
    draws of three channels has a standard error of 0.7 %."""
    random, n, rate_hz = np.random.default_rng(11), 16384, 200.0
    hz = np.fft.rfftfreq(n, 1.0 / rate_hz)
    moved = ((hz > 2.0) & (hz < 8.0)).astype(np.complex128)

    def shaped(amplitude: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        lines = np.fft.rfft(random.standard_normal((n, 3)), axis=0)
        rows = np.fft.irfft(lines * amplitude[:, None], n, axis=0)
        return np.asarray(rows / rows.std(axis=0))

    # Of noise whose power grows as f^(2 d) up to f, that of du/dt is (2 d + 1) / (2 d + 3) (2 pi f)^2 times that of u.
    per_s = np.pi * rate_hz * np.sqrt((2 * derivatives + 1) / (2 * derivatives + 3))
    stated = 5.0 * np.outer([1.0, per_s], np.ones(3))
    counted = []
    for _ in range(5):
        motion, white = 30.0 * shaped(moved), shaped((2j * np.pi * hz) ** derivatives)
        counted.append(not_more_than_incoherent(stated, motion + white, motion, rate_hz, derivatives) / stated)
    assert np.mean(counted) == pytest.approx(np.sqrt(0.5) / 5.0, rel=0.03)
    assert np.ptp(counted, axis=1).max() == pytest.approx(0.0, abs=1e-12)  # u and du/dt alike
