"""A gain that changes within a recording is told, and U covers both halves. A sound recording tells nothing."""

from __future__ import annotations

import numpy as np
import pytest

from calib import calibrate
from calib.model import Array
from calib.recorded.outcome import Outcome

RATE_HZ, SECONDS = 100.0, 300.0
S = np.array([[1.01, 0.004, -0.002], [0.003, 0.99, 0.006], [-0.005, 0.001, 1.02]])


def outcome_of(seed: int, gain: float, from_s: float = 0.5 * SECONDS) -> Outcome:
    """Motion of 0.1 m/s2 from 1 to 8 Hz beside a DC-coupled reference; output z times `gain` from a time on."""
    random, n = np.random.default_rng(seed), round(SECONDS * RATE_HZ)
    t, hz = np.arange(n) / RATE_HZ, np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    lines = np.fft.rfft(random.normal(size=(n, 3)), axis=0)
    a: Array = np.fft.irfft(lines * ((hz > 1.0) & (hz < 8.0))[:, None], n, axis=0)
    a = 0.1 * a / a.std() + [0.0, 0.0, 9.81]
    u = a + 1e-4 * random.normal(size=a.shape)
    V = a @ S.T + [0.1, -0.2, 0.05] + 2e-3 * random.normal(size=a.shape)
    V[t >= from_s, 2] *= gain
    found = calibrate((t, V), (t, u), rotation=np.eye(3))
    assert isinstance(found, Outcome)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "from_s"), [(1.03, 150.0), (0.97, 150.0), (1.03, 100.0)])
def test_a_gain_that_changes_is_told_and_covered(gain: float, from_s: float) -> None:
    found = outcome_of(1, gain, from_s)
    assert found.calibration is not None
    assert [w for w in found.warnings if w.startswith("S changed within the recording: Szz is 1.0")]
    for true in (1.02, 1.02 * gain):
        assert abs(found.calibration.sensitivity[2, 2] - true) < found.expanded_uncertainty[8]
    by_change = found.more["budget"]["change within the recording"]
    assert by_change["Szz"] == pytest.approx(0.0153, abs=0.0005)
    assert by_change["Sxx"] < 0.0005  # what did not change


@pytest.mark.slow
def test_a_sound_recording_tells_nothing() -> None:
    for seed in range(4):
        found = outcome_of(seed, 1.0)
        assert not found.warnings
        assert "change within the recording" not in found.more["budget"]
