"""Hum of the mains in sensor and reference: coherent, but no motion. It costs its lines."""

from __future__ import annotations

import numpy as np
import pytest

from calib.excitation.hum import hum_hz, without_lines
from calib.model import Array
from tests.unit.drawn_recording import Devices, Recording, in_force, reports

RATE_HZ, MAINS_HZ = 200.0, 50.01
DEVICES = Devices(rate_hz=RATE_HZ, reference_rate_hz=RATE_HZ, band_hz=(0.5, 12.0), level_mps2=0.1)


def hum(random: np.random.Generator, t: Array) -> Array:
    """(n, 3) of 30 to 50 mm/s2 at the first and the third harmonic, as a ground loop brings it into one device."""
    size, phase = random.uniform(0.03, 0.05, (2, 1, 3)), random.uniform(0.0, 2.0 * np.pi, (2, 1, 3))
    parts = [
        a * np.cos(2.0 * np.pi * k * MAINS_HZ * t[:, None] + p) for k, a, p in zip((1, 3), size, phase, strict=True)
    ]
    return np.asarray(sum(parts))


@pytest.mark.thorough
def test_hum_in_both_devices_costs_no_window() -> None:
    """Without the filter no window of these is taken: the response does not settle, or the window contradicts."""
    made, random = Recording(1, DEVICES, bench=False), np.random.default_rng(9)
    without = in_force(made.through_agent())
    made.V += hum(random, made.sensor_s)
    made.x += hum(random, made.reference_s)
    results = made.through_agent()
    found = in_force(results)
    assert all(report.used for report in reports(results))
    assert all(report.numbers["hum_lines"] == 1.0 for report in reports(results))  # the third is at 50 Hz as well
    u = np.sqrt(np.diag(found.covariance))[:9].reshape(3, 3)
    assert (np.abs(np.array(found.sensitivity) - without.sensitivity) < 0.5 * u).all()
    assert u[0, 0] < 1.1 * np.sqrt(without.covariance[0][0])


@pytest.mark.parametrize("beside", [0.0, 0.1], ids=["shaker", "machine"])
def test_motion_at_the_frequency_of_the_mains_is_no_hum(beside: float) -> None:
    random, t = np.random.default_rng(2), np.arange(8000) / RATE_HZ
    u = beside * np.cumsum(random.normal(size=(8000, 3)), axis=0) / 50.0 + 1e-3 * random.normal(size=(8000, 3))
    u += 0.05 * np.cos(2.0 * np.pi * MAINS_HZ * t)[:, None] * [1.0, 0.5, 0.2]
    V = u @ np.array([[1.02, 0.01, 0.0], [0.0, 0.98, 0.02], [0.01, 0.0, 1.0]]) + 1e-3 * random.normal(size=(8000, 3))
    assert hum_hz(u, V, RATE_HZ) == []
    assert hum_hz(u, V + hum(random, t), RATE_HZ) == ([] if not beside else pytest.approx([MAINS_HZ], abs=0.03))


def test_the_filter_takes_out_a_line_and_nothing_else() -> None:
    t = np.arange(8000) / RATE_HZ
    kept = 9.8 + np.cos(2.0 * np.pi * 48.0 * t) + np.cos(2.0 * np.pi * 3.0 * t)
    out = without_lines((kept + np.cos(2.0 * np.pi * 50.0 * t))[:, None], RATE_HZ, [50.0])[:, 0]
    whole = np.isfinite(out)
    assert whole.sum() == 8000 - 2 * 400
    assert np.abs(out - kept)[whole].max() < 0.01
