"""Two seismometers side by side whose ratio over frequency is far from constant: no single S is told for them.

The ratio of their velocities is that of their accelerations, so the counts stand for both. The sensor has one component
here, which takes the place of all three axes.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from calib import calibrate
from calib.recorded.outcome import Outcome
from tests.realdata.datasets import dataset

EXACT = (
    "u_angle_deg", "u_theta_deg", "u_alpha_common_deg", "u_transverse_motion_pct", "u_reference_pct",
)  # fmt: skip
SCALE = 1e4  # counts of the reference that stand for 1 m/s2
LINES = 8192
BAND_HZ = (0.45, 19.0)


def ratio(sensor: np.ndarray, reference: np.ndarray, rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies, and the size of the sensor's response over that of the reference: by Welch's method."""
    window = np.hanning(LINES)
    starts = range(0, len(sensor) - LINES, LINES // 2)
    x, y = (
        np.fft.rfft([window * (v[k : k + LINES] - v[k : k + LINES].mean()) for k in starts])
        for v in (reference, sensor)
    )
    cross, power = (x.conj() * y).sum(axis=0), (np.abs(x) ** 2).sum(axis=0)
    return np.fft.rfftfreq(LINES, 1.0 / rate_hz), np.abs(cross / power)


def recorded() -> tuple[np.ndarray, np.ndarray, float]:
    """Counts of the sensor and of the reference, and their rate."""
    held = np.load(dataset("relcal") / "vertical.npz")
    return held["sensor_count"].astype(float), held["reference_count"].astype(float), float(held["rate_hz"])


def calibrated(sensor: np.ndarray, reference: np.ndarray, rate_hz: float) -> Outcome:
    time_s = np.arange(len(sensor)) / rate_hz
    poses = [{"start_s": k, "stop_s": k + 60, "dx": 1, "dy": 0, "dz": 0} for k in range(5, 600, 60)]
    return calibrate(
        (time_s, np.column_stack([sensor] * 3)), {"time_s": time_s, "a": reference / SCALE}, poses,
        coupling="ac", **dict.fromkeys(EXACT, 0.0),
    )  # fmt: skip


@pytest.mark.thorough
@pytest.mark.slow
def test_all_that_was_recorded_is_refused_and_its_response_told() -> None:
    """Up to 100 Hz the ratio grows to 2.6 and falls again: no smooth response explains it, and no S is told. Each band
    tells the response by itself."""
    sensor, reference, rate_hz = recorded()
    found = calibrated(sensor, reference, rate_hz)
    assert found.status == "refused"
    assert any("no smooth response over frequency explains the bands" in reason for reason in found.reasons)
    assert found.calibration is None or np.isnan(found.calibration.sensitivity).all()
    frequency_hz, h = ratio(sensor, reference, rate_hz)
    away, u = [], []
    for band in found.more["response"]:
        middle_hz = np.sqrt(band["low_hz"] * band["high_hz"])
        size = abs(complex(band["sensitivity_re"][0][0], band["sensitivity_im"][0][0])) / SCALE
        if 0.5 < middle_hz < 18.0 and np.isfinite(size):
            other = h[1:][np.abs(np.log(frequency_hz[1:] / middle_hz)) < 0.03].mean()
            away.append(size / other - 1.0)
            u.append(band["standard_uncertainty"][0][0] / SCALE / size)
    assert len(away) >= 25
    assert np.median(u) < 0.005
    over_u = np.abs(away) / u
    assert over_u.max() < 3.0
    assert np.count_nonzero(over_u < 2.0) >= 0.85 * len(away)  # Welch's spectra scatter as well


def test_the_response_in_a_band_is_that_of_the_spectra() -> None:
    """Both series pass the same filter, so that their ratio stays what it is."""
    sensor, reference, rate_hz = recorded()
    frequency_hz, h = ratio(sensor, reference, rate_hz)
    sections = butter(6, BAND_HZ, "bandpass", fs=rate_hz, output="sos")
    filtered = [sosfiltfilt(sections, v - v.mean()) for v in (sensor, reference)]
    found = calibrated(filtered[0], filtered[1], rate_hz)
    assert found.status == "valid"
    low_hz, high_hz = found.more["valid_band_hz"]
    assert high_hz / low_hz < 2.0  # S alone is right near its frequency only, and says so
    bands = found.more["response"]
    middles_hz = np.array([np.sqrt(band["low_hz"] * band["high_hz"]) for band in bands])
    assert middles_hz[0] < 0.6
    assert middles_hz[-1] > 17.0
    for middle_hz, band in zip(middles_hz, bands, strict=True):
        other = h[1:][np.abs(np.log(frequency_hz[1:] / middle_hz)) < 0.03].mean()
        size = abs(complex(band["sensitivity_re"][0][0], band["sensitivity_im"][0][0])) / SCALE
        expanded = 2.0 * band["standard_uncertainty"][0][0] / SCALE
        assert expanded < 0.02 * size
        assert abs(size - other) < expanded
