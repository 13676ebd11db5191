"""An AC-coupled reference whose samples hold loud motion before quiet motion: what the quiet window says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from calib.excitation.front_end import Settings, windows_of
from calib.excitation.windows import Points
from calib.model import Array, Pose, Window
from calib.signal.corner import integral
from calib.signal.instrument import Instrument
from calib.signal.samples import Samples
from calib.signal.stamps import clock_from_stamps
from calib.windows.record import Record

RATE_HZ, LOUD_S, SECONDS = 125.0, 5.0, 70.0
CORNER_HZ = 0.05
S = np.array([[1.01, 0.004, -0.002], [0.003, 0.99, 0.006], [-0.005, 0.001, 1.02]])


def quiet_window(seed: int, loud_mps2: float) -> Window:
    """That of motion of 10 mm/s2 from 1 to 10 Hz after five seconds of `loud_mps2`. The reference has a zero error."""
    random, n = np.random.default_rng(seed), round(SECONDS * RATE_HZ)
    t, hz = np.arange(n) / RATE_HZ, np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    a: Array = np.fft.irfft(
        np.fft.rfft(random.normal(size=(n, 3)), axis=0) * ((hz > 1) & (hz < 10))[:, None], n, axis=0
    )
    a *= np.where(t < LOUD_S, loud_mps2, 0.01)[:, None] / a.std()
    half = np.pi * CORNER_HZ / RATE_HZ
    x = lfilter(np.array([1.0, -1.0]), np.array([1.0 + half, half - 1.0]), a, axis=0)
    x += 1e-3 + 1e-5 * random.normal(size=(n, 3))
    V = a @ S.T + [0.1, -0.2, 9.8] + 2e-3 * random.normal(size=(n, 3))
    clock = clock_from_stamps(t)
    pose = Pose("p", np.eye(3), np.array([0.0, 0.0, 9.80665]))
    instrument = Instrument(corner_hz=CORNER_HZ, u_corner_hz=0.05 * CORNER_HZ)
    sensor, reference = Samples("sensor", 0, V, clock), Samples("reference", 0, x, clock)
    settings = Settings(most_noise=(1e-5 / np.sqrt(0.5 * RATE_HZ),) * 3)  # as quieter hours told it
    span_s = LOUD_S + 1.0, SECONDS - 1.0
    windows = windows_of(pose, sensor, reference, instrument, span_s, settings=settings)
    return max((w for w in windows if w.used), key=lambda w: w.points)


@pytest.mark.slow
@pytest.mark.parametrize("loud_mps2", [0.01, 3.0])
def test_the_slopes_of_the_quiet_window_are_right(loud_mps2: float) -> None:
    """The integral of the reference has a straight line from the loud part: chi-squared was 90 times as large."""
    statistics = []
    for seed in range(6):
        record = Record.of(quiet_window(seed, loud_mps2), 0.0)
        true = np.vstack([S.T, np.zeros((9, 3))])
        left = (record.slopes - record.root @ true) / record.noise
        live = np.flatnonzero(np.diag(record.root))
        assert live.tolist() == [*range(9)]  # the derivative of an integral is the channel itself
        statistics.append(record.independent * float(np.sum(left[live] ** 2)))
    # Of 6 x 27 rows: 1 with a standard deviation of 0.11; what the reference's noise adds is small.
    assert 0.6 < np.mean(statistics) / 27.0 < 1.45


def test_slow_waves_keep_their_lines() -> None:
    """Ten seconds of waves of nine seconds are half a line: without it they would tell another mixture of frequencies
    than there is. The same samples with motion of 3 Hz in their place lose it, and all columns alike."""
    t = np.arange(1250) / RATE_HZ
    for hz, kept in ((0.11, True), (3.0, False)):
        phase = 2.0 * np.pi * hz * t
        u = np.column_stack([np.sin(phase + k) for k in range(6)]) + 1e-3 * t[:, None]
        points = Points(t, u[:, :3] + 0.1, u, 2.0 * np.pi * hz * np.column_stack([np.cos(phase + k) for k in range(6)]))
        assert (points.without_line is points) == kept
        slopes = [abs(np.polyfit(t, own, 1)[0]).max() for own in points.without_line[1:4]]
        assert (max(slopes) < 1e-9) != kept
    np.testing.assert_allclose(points.without_line.V.mean(axis=0), points.V.mean(axis=0))


def test_a_blow_at_the_end_does_not_tilt_the_integral_of_the_quiet_time_before() -> None:
    """The zero error gives the integral a straight line, which is that of the quiet time; by least squares over all
    samples alike it would be off by more than twice the motion there."""
    t = np.arange(7500) / RATE_HZ
    quiet = np.sin(2.0 * np.pi * 1.1 * t)
    blow = np.where(t > 54.0, -100.0 * np.exp((54.0 - t) / 3.0), 0.0)
    exact = quiet + blow
    x = np.gradient(exact, 1.0 / RATE_HZ) / (2.0 * np.pi) + 1e-2
    found = integral(x[:, None], RATE_HZ)[:, 0]
    left = (found - exact)[200:6500]
    assert np.ptp(left) < 0.25
    alike = 2.0 * np.pi * np.cumsum(x) / RATE_HZ
    alike -= np.polyval(np.polyfit(t, alike, 1), t)
    assert np.ptp((alike - exact)[200:6500]) > 2.0
