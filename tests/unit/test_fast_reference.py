"""A reference that is much faster than the sensor: its noise is not folded into the band of the motion, and a motion
that fills the sensor's spectrum is not taken for noise."""

from __future__ import annotations

import numpy as np
import pytest

from calib.excitation.front_end import windows_of
from calib.model import Array, Pose, Window
from calib.signal.band import UNFOLDED, unfolded
from calib.signal.instrument import Instrument
from calib.signal.samples import Samples
from calib.signal.stamps import clock_from_stamps
from calib.windows.condense import condense, regressed
from calib.windows.excited import excited

SENSOR_HZ, REFERENCE_HZ, GAIN = 62.5, 500.0, 1.02
SPAN_S = (3.0, 63.0)
POSE = Pose("beside", np.eye(3), np.zeros(3))


def window(seed: int, to_hz: float, density: float, level: float = 0.02) -> Window:
    """A sensor on random motion from 0.5 Hz to `to_hz` beside a reference with white noise of this density, in m/s2
    per root Hz. All instruments are exact at the times of their samples."""
    random = np.random.default_rng(seed)
    n = round(66.0 * REFERENCE_HZ)
    frequency_hz = np.fft.rfftfreq(n, 1.0 / REFERENCE_HZ)
    lines = random.normal(size=(len(frequency_hz), 3, 2)) @ [1, 1j]
    a = np.fft.irfft(lines * ((frequency_hz > 0.5) & (frequency_hz < to_hz))[:, None], n, axis=0)
    a *= level / a.std()
    slower = round(REFERENCE_HZ / SENSOR_HZ)
    V = GAIN * a[::slower] + 1e-4 * random.normal(size=(n // slower, 3))
    u = a + density * np.sqrt(0.5 * REFERENCE_HZ) * random.normal(size=a.shape)
    sensor = Samples("sensor", 0, V, clock_from_stamps(np.arange(len(V)) / SENSOR_HZ))
    reference = Samples("reference", 0, u, clock_from_stamps(np.arange(n) / REFERENCE_HZ))
    [made] = windows_of(POSE, sensor, reference, Instrument(), SPAN_S)
    return made


def slopes(of: Window) -> Array:
    """(3, 3) S by this window."""
    data = condense([excited(of)])
    return np.asarray(regressed(data.root[0], data.slopes[0])[:3].T)


def test_the_noise_of_a_fast_reference_makes_s_no_smaller() -> None:
    """Ten seeds, noise of 5e-4 m/s2 per root Hz: 7 % of the motion below 8 Hz, and 20 % of it when folded there. The
    mean of the main sensitivities, which each window tells to 0.4 %, is right to 0.2 %."""
    main = [np.diag(slopes(window(seed, 8.0, 5e-4))) for seed in range(10)]
    assert np.mean(main) / GAIN == pytest.approx(1.0, abs=2e-3)
    assert np.std(main) < 0.01


def test_what_would_be_folded_is_gone_and_the_motion_is_whole() -> None:
    t = np.arange(4000) / REFERENCE_HZ
    tones_hz = np.array([2.0, UNFOLDED * SENSOR_HZ, (1.0 - UNFOLDED) * SENSOR_HZ, 100.0, 240.0])
    passed = unfolded(np.sin(2.0 * np.pi * tones_hz * t[:, None]), REFERENCE_HZ, SENSOR_HZ)
    middle = slice(1000, 3000)
    phases = np.exp(-2j * np.pi * tones_hz * t[middle, None])
    amplitude = np.abs(np.mean(2.0 * passed[middle] * phases, axis=0))
    assert amplitude[:2] == pytest.approx(1.0, abs=3e-5)
    assert (amplitude[2:] < 3e-5).all()


def test_samples_of_about_one_rate_pass_as_they_are() -> None:
    x = np.random.default_rng(1).normal(size=(500, 3))
    assert unfolded(x, 100.0, 100.0) is x
    assert unfolded(x, 100.0, 84.0) is x


def test_motion_that_fills_the_spectrum_of_the_sensor_is_no_noise_of_the_reference() -> None:
    """Motion to 40 Hz at 62.5 samples a second looks white; the reference at 500 Hz shows that its noise is less.
    Before, the reference was silent here."""
    made = window(1, 40.0, 2e-5, level=6e-4)
    assert made.used, made.reason
    assert made.numbers["reference_noise_mps2"] == pytest.approx(2e-5 * np.sqrt(3 * 20.0), rel=0.2)
