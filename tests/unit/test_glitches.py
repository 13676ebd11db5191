"""Spikes and steps of a reference: found where they are, nothing else is, and S does not suffer from them."""

from __future__ import annotations

import numpy as np
import pytest

from calib.adjustment.adjustment import adjust
from calib.excitation.front_end import Settings, windows_of
from calib.geometry import along
from calib.model import Array, Window
from calib.signal.glitches import glitches
from calib.signal.instrument import Instrument
from calib.signal.samples import Samples
from calib.signal.timing import ClockModel

QUANTITY = ("acceleration", "velocity", "displacement")
RATE_HZ, N = 500.0, 10_000
S_TRUE = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.01], [-0.01, 0.02, 1.01]])
AMPLITUDE, FREQUENCY_HZ = np.array([5.0, 2.0]), np.array([3.0, 5.3])


def motion(derivatives: int, phase: float = 0.0) -> Array:
    """(N,) acceleration, or its first or second integral over time."""
    t, omega = np.arange(N)[:, None] / RATE_HZ, 2 * np.pi * FREQUENCY_HZ
    return np.sum(AMPLITUDE * np.sin(omega * t + phase - derivatives * np.pi / 2) / omega**derivatives, axis=1)


def gaussian(seed: int, band_hz: float) -> Array:
    """(N, 3) motion up to `band_hz` with white noise, a thousandth of it."""
    rng = np.random.default_rng(seed)
    lines = np.fft.rfft(rng.normal(size=(N, 3)), axis=0)
    lines[np.fft.rfftfreq(N, 1 / RATE_HZ) > band_hz] = 0.0
    moved = np.fft.irfft(lines, N, axis=0)
    return np.asarray(moved / moved.std() + 1e-3 * rng.normal(size=(N, 3)))


@pytest.mark.parametrize("band_hz", [2.0, 40.0, 200.0])
def test_gaussian_motion_has_none(band_hz: float) -> None:
    assert sum(glitches(gaussian(seed, band_hz)).sum() for seed in range(40)) == 0  # of 1.2 million samples


def test_motion_that_begins_at_once_rings_or_rests_in_steps_has_none() -> None:
    t = np.arange(N) / RATE_HZ
    struck = np.where(t > 10.0, 20.0 * np.exp(-(t - 10.0) / 0.1) * np.sin(2 * np.pi * 60.0 * (t - 10.0)), 0.0)
    noise = 1e-3 * np.random.default_rng(1).normal(size=N)
    assert not glitches((struck + noise)[:, None]).any()
    assert not glitches(np.round(5.0 * np.sin(2 * np.pi * 0.1 * t))[:, None]).any()
    assert not glitches(np.zeros((N, 1))).any()
    frequent = noise.copy()
    frequent[::40] += 10.0
    assert not glitches(frequent[:, None]).any(), "what is as frequent is no glitch"


@pytest.mark.parametrize("seed", range(20))
def test_spikes_and_steps_are_found_where_they_are(seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    x = gaussian(seed, 20.0)
    at = np.sort(rng.choice(np.arange(50, N - 50, 40), 20, replace=False))
    for k in at[:10]:
        x[k, rng.integers(3)] += rng.choice([-1, 1]) * rng.uniform(1.0, 1000.0)
    for k in at[10:]:
        x[k:, rng.integers(3)] += rng.choice([-1, 1]) * rng.uniform(1.0, 1000.0)
    assert np.flatnonzero(glitches(x)).tolist() == sorted([*at[:10], *at[10:], *(at[10:] - 1)])


def recorded(derivatives: int, spikes: float, steps: float, settings: Settings) -> list[Window]:
    """Windows along x, y and z; the reference has a spike at 9.3 s, and steps at 0.3 s and 19.6 s."""
    rng, windows = np.random.default_rng(3), []
    t, model = np.arange(N) / RATE_HZ, ClockModel(RATE_HZ)
    count = np.arange(24, N, 25)
    model.update(count, count / RATE_HZ)
    for k in range(3):
        u = motion(derivatives, k) + (1e-4, 1e-4, 1e-7)[derivatives] * rng.normal(size=N)
        u[t >= 0.3] += steps
        u[t >= 19.6] -= 2.0 * steps
        u[round(9.3 * RATE_HZ)] += spikes
        V = np.outer(motion(0, k), S_TRUE[:, k]) + 0.01 * rng.normal(size=(N, 3))
        sensor, reference = (
            Samples(name, 0, values, model.result()) for name, values in (("acc", V), ("ref", u[:, None]))
        )
        pose = along(np.eye(3)[k], np.zeros(3), "xyz"[k])
        windows += windows_of(pose, sensor, reference, Instrument(QUANTITY[derivatives]), (0.0, 20.0), 0.0, settings)
    return windows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("derivatives", "spikes", "steps"),
    [(0, 50.0, 0.0), (0, 500.0, 0.0), (0, 5000.0, 0.0), (1, 0.0, 0.8), (1, 50.0, 0.0), (1, 5.0, 10.0), (2, 0.0, 0.1)],
)
def test_s_does_not_suffer_from_them(derivatives: int, spikes: float, steps: float) -> None:
    windows = recorded(derivatives, spikes, steps, Settings())
    found = adjust(windows)
    assert found.reasons == ()
    error = np.abs(found.calibration.sensitivity - S_TRUE).ravel()
    assert found.calibration.determined[:9].all()
    assert (error <= 3.0 * found.calibration.standard_uncertainty[:9]).all()
    assert error[[0, 4, 8]].max() < 1e-3
    assert all(max(w.stop_s - w.start_s for w in windows if w.used and w.pose.position == p) > 8.0 for p in "xyz")
    assert sum(w.numbers.get("reference_glitches", 0.0) for w in windows if w.used) >= 3.0


def test_method_3_as_printed_keeps_them() -> None:
    windows = recorded(0, 500.0, 0.0, Settings(leave_out=False, limit_band=False))
    assert not any("reference_glitches" in w.numbers for w in windows)
