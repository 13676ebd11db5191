"""Samples lost one by one: what a filter and resampling would make of their holes is filled first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.excitation.front_end import Aligned, aligned, windows_of
from calib.model import Array, Pose
from calib.signal.band import without_short_holes
from calib.signal.holes import short_holes_filled
from calib.signal.instrument import Instrument
from calib.signal.samples import Samples
from calib.signal.stamps import clock_from_stamps

RATE_HZ, BAND_HZ, SPAN_S = 100.0, 12.0, (2.995, 42.995)
SENSOR_NOISE, REFERENCE_NOISE = 0.005, 0.001  # m/s2
LOST = 0.03
GRAVITY = np.array([0.0, 0.0, 9.80665])
S_TRUE = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])


def motion(random: np.random.Generator, n: int, high_hz: float, level: float) -> Array:
    """(n, 3) random motion between 0.5 Hz and `high_hz`, with this rms."""
    frequency_hz = np.fft.rfftfreq(n, 1 / RATE_HZ)
    lines = random.normal(size=(len(frequency_hz), 3, 2)) @ [1, 1j]
    moved = np.fft.irfft(lines * ((frequency_hz > 0.5) & (frequency_hz < high_hz))[:, None], n, axis=0)
    return np.asarray(level * moved / moved.std())


def pair(seed: int, lost: str, reference_noise: float = REFERENCE_NOISE) -> tuple[Samples, Samples]:
    """A sensor and a reference on one clock with motion up to 12 Hz of 0.05 m/s2; one of them may lose samples."""
    random = np.random.default_rng(seed)
    n = round(46 * RATE_HZ)
    a = motion(random, n, BAND_HZ, 0.05)
    V = (a + GRAVITY) @ S_TRUE.T + SENSOR_NOISE * random.normal(size=a.shape)
    u = a + reference_noise * random.normal(size=a.shape)
    holes = random.random(n) < LOST
    if lost:
        (V if lost == "sensor" else u)[holes] = np.nan
    clock = clock_from_stamps(np.arange(n) / RATE_HZ)
    return Samples("sensor", 0, V, clock), Samples("reference", 0, u, clock)


def points(seed: int, lost: str, reference_noise: float = REFERENCE_NOISE) -> Aligned:
    found = aligned(*pair(seed, lost, reference_noise), Instrument(), SPAN_S)
    assert found is not None
    return found


@pytest.mark.parametrize("lost", ["sensor", "reference"])
def test_three_percent_of_lost_samples_leave_one_window(lost: str) -> None:
    sensor, reference = pair(1, lost)
    pose = Pose("beside", np.eye(3), GRAVITY)
    [window] = windows_of(pose, sensor, reference, Instrument(), SPAN_S)
    assert window.used, window.reason
    assert window.points == round(RATE_HZ * (SPAN_S[1] - SPAN_S[0]))
    inside = slice(round(SPAN_S[0] * RATE_HZ + 0.5), round(SPAN_S[1] * RATE_HZ + 0.5))
    device = sensor if lost == "sensor" else reference
    holes = int(np.isnan(device.values[inside, 0]).sum())
    name = "filled_samples" if lost == "sensor" else "reference_filled_samples"
    assert window.numbers[name] == holes
    [whole] = windows_of(pose, *pair(1, ""), Instrument(), SPAN_S)
    assert window.independent == pytest.approx(whole.independent * (1 - holes / window.points), rel=0.02)
    assert not {"filled_samples", "reference_filled_samples"} & set(whole.numbers)


@pytest.mark.one_case
@pytest.mark.parametrize("lost", ["sensor", "reference"])
def test_the_filtered_samples_are_those_without_loss(lost: str) -> None:
    """Twenty seeds: 3 % of the information is gone, and no more than that comes in as error.

    Noise of variance s2 in a sample, its own and that of its filled value, gives a filtered error of about
    independent * 2 * 3 % * s2.
    """
    excess = []
    for seed in range(20):
        whole, holed = points(seed, ""), points(seed, lost)
        both = np.isin(whole.points.time_s, holed.points.time_s)  # a hole of three samples costs the filter's length
        assert both.mean() > 0.95
        column, noise = ("V", SENSOR_NOISE) if lost == "sensor" else ("u", REFERENCE_NOISE)
        error = getattr(holed.points, column) - getattr(whole.points, column)[both]
        excess.append(np.mean(error**2) / (2 * LOST * whole.independent * noise**2))
    assert 0.3 < np.mean(excess) < 1.5


@pytest.mark.one_case
@pytest.mark.parametrize("lost", ["", "sensor", "reference"])
def test_the_sensitivity_scatters_as_the_real_samples_tell(lost: str) -> None:
    """Forty seeds of nine coefficients: errors over u from the independent points, rms within chi2's 99.9 %."""
    errors = []
    for seed in range(40):
        found = points(seed, lost)
        t, V, u, du, *_ = found.points
        basis = np.column_stack([np.ones(len(t)), u, du])
        solution, *_ = np.linalg.lstsq(basis, V, rcond=None)
        residual = V - basis @ solution
        dof = found.independent * len(t) - basis.shape[1]
        variance = np.sum(residual**2, axis=0) / dof
        u_slope = np.sqrt(np.diag(np.linalg.inv(basis.T @ basis))[1:4, None] * variance)
        errors.append((solution[1:4] - S_TRUE.T) / u_slope)
    assert 0.88 < np.sqrt(np.mean(np.square(errors))) < 1.13


def test_holes_of_the_reference_are_filled_by_its_own_band_where_the_sensor_feels_a_wider_one() -> None:
    """The sensor's motion of 24 Hz leaves hardly any of the spectrum between which a value could be filled."""
    random = np.random.default_rng(7)
    u, V = (motion(random, 4600, high_hz, 0.05) for high_hz in (6.0, 24.0))
    exact = u + REFERENCE_NOISE * random.normal(size=u.shape)
    u = exact.copy()
    holes = np.arange(40, 4560, 40)
    u[holes] = np.nan
    filled_u, _, filled, none = without_short_holes(
        u, V + REFERENCE_NOISE * random.normal(size=V.shape), (100.0, 100.0)
    )
    assert np.flatnonzero(filled).tolist() == holes.tolist()
    assert not none.any()
    assert np.sqrt(np.mean((filled_u - exact)[holes] ** 2)) < 1.5 * REFERENCE_NOISE


def test_without_a_filter_a_filled_sample_of_the_sensor_is_no_point() -> None:
    found = points(2, "sensor", reference_noise=1e-6)
    assert found.band_hz is None
    sensor, _ = pair(2, "sensor", 1e-6)
    real = np.isfinite(sensor.values[:, 0])
    np.testing.assert_array_equal(found.points.time_s, sensor.time_s[real & _inside(sensor)])
    assert "filled_samples" not in found.filled
    assert found.independent == 1.0


def _inside(samples: Samples) -> np.ndarray:
    return (samples.time_s >= SPAN_S[0]) & (samples.time_s < SPAN_S[1])


@pytest.mark.parametrize("run", [1, 2])
def test_a_filled_value_is_no_noisier_than_two_samples(run: int) -> None:
    random = np.random.default_rng(5)
    exact = motion(random, 6000, BAND_HZ, 1.0) + GRAVITY
    x = exact + SENSOR_NOISE * random.normal(size=exact.shape)
    for first in range(30, 6000, 40):
        x[first : first + run] = np.nan
    out, filled = short_holes_filled(x, RATE_HZ, 1.25 * BAND_HZ)
    assert filled.sum() == run * 150
    np.testing.assert_array_equal(out[~filled], x[~filled])
    ratio = np.std(out[filled] - exact[filled]) / SENSOR_NOISE
    assert 0.5 < ratio < 1.3


def test_holes_that_the_samples_around_do_not_determine_stay() -> None:
    random = np.random.default_rng(6)
    x = random.normal(size=(600, 1))
    x[[0, 100, 300, 301, 302, 304, 599]] = np.nan
    out, filled = short_holes_filled(x, RATE_HZ, BAND_HZ)
    assert np.flatnonzero(filled).tolist() == [100, 304]
    assert np.isnan(out[[0, 300, 301, 302, 599]]).all()
    same, none = short_holes_filled(x, RATE_HZ, 0.45 * RATE_HZ)  # motion in nearly all of the spectrum
    assert same is x
    assert not none.any()


def test_motion_that_only_the_sensor_feels_is_not_guessed() -> None:
    """A machine shakes the sensor alone at 33 Hz: the samples around a hole do not determine that motion."""
    sensor, reference = pair(3, "sensor")
    shaken = sensor.values + 0.05 * np.sin(2 * np.pi * 33.0 * sensor.time_s)[:, None]
    found = aligned(replace(sensor, values=shaken), reference, Instrument(), SPAN_S)
    assert found is None or not found.filled
