"""The last minute of a corrected stream and its spectrum, against scipy and closed formulas."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.signal import welch

from agent.core.events import Acceleration
from agent.monitor.spectrum import BANDWIDTH_BINS, LastMinute, density_of, usable

RATE_HZ = 100.0


def block(values: np.ndarray, first_index: int, rate_hz: float = RATE_HZ) -> Acceleration:
    return Acceleration(
        sensor="s", t_utc_ns=10**9 * first_index, first_index=first_index, rate_hz=rate_hz,
        acceleration=values, covariance=np.eye(3), noise=np.ones(3), determined=np.ones(12, dtype=bool),
        calibration_run_id="r", calibration_sequence=1, dynamic_only=False, recorded=False,
        suspect=np.zeros(3, dtype=bool),
    )  # fmt: skip


@pytest.mark.parametrize("length", [8, 999, 1000, 4096])
def test_the_density_is_that_of_scipy(length: int) -> None:
    values = np.random.default_rng(1).normal([9.81, 0.0, -3.0], 1.0, (6000, 3))
    hz, density = density_of(values, RATE_HZ, length)
    expected_hz, expected = welch(values, RATE_HZ, "hann", length, axis=0)
    np.testing.assert_allclose(hz, expected_hz, rtol=1e-12)
    np.testing.assert_allclose(density, expected, rtol=1e-9, atol=1e-12 * expected.max())


def test_a_sine_has_its_power_at_its_frequency_and_noise_its_variance() -> None:
    t, minute = np.arange(6000) / RATE_HZ, LastMinute()
    noise = 0.1 * np.random.default_rng(2).standard_normal(len(t))
    values = np.column_stack([2.0 * np.sin(2 * np.pi * 12.5 * t), noise, np.full(len(t), 9.81)])
    for k in range(0, len(t), 50):
        minute.add(block(values[k : k + 50], k))
    told = json.loads(json.dumps(minute.as_object(), allow_nan=False))
    assert (told["seconds"], told["segments"], told["begun_anew"], told["segment_s"]) == (60.0, 11, 0, 10.0)
    hz, density = np.array(told["frequency_hz"]), np.array(told["density"])
    assert hz[np.argmax(density[0])] == 12.5
    line_hz = hz[1] - hz[0]
    assert told["resolution_hz"] == pytest.approx(BANDWIDTH_BINS * line_hz)
    assert density[0].max() == pytest.approx(
        2.0 / told["resolution_hz"], rel=1e-3
    )  # its mean square over the bandwidth
    assert density[0].sum() * line_hz == pytest.approx(2.0, rel=1e-3)
    assert density[1].sum() * line_hz == pytest.approx(0.01, rel=0.06)  # chi-squared: 3 sigma of 6000 points
    assert density[2].max() < 1e-20
    assert len(told["course"]["low"][0]) == 600
    assert max(told["course"]["high"][0]) == pytest.approx(2.0, rel=1e-3)


def test_lost_samples_begin_the_minute_anew_and_older_ones_go() -> None:
    minute, values = LastMinute(), np.zeros((50, 3))
    for k in range(200):
        minute.add(block(values, 50 * k))
    assert minute.as_object()["seconds"] == 60.0
    minute.add(block(values, 50 * 201))
    told = minute.as_object()
    assert (told["seconds"], told["begun_anew"], told["segments"]) == (0.5, 1, 0)
    minute.add(block(values, 50 * 202, rate_hz=200.0))
    assert minute.as_object()["begun_anew"] == 2


def test_a_block_that_cannot_be_computed_with_is_left_out() -> None:
    assert usable(block(np.zeros((5, 3)), 0))
    assert not usable(block(np.zeros((0, 3)), 0))
    assert not usable(block(np.full((5, 3), np.nan), 0))
    for rate_hz in (0.0, -1.0, np.nan, np.inf, 1e300):
        assert not usable(block(np.zeros((5, 3)), 0, rate_hz))
