"""Two clocks that run apart: the drift is found from the windows, and taken out of them."""

from __future__ import annotations

import numpy as np
import pytest

from calib import calibrate
from calib.excitation.windows import Points, motion_windows
from calib.geometry import beside, clamp
from calib.model import Pose, Window
from calib.paper.method3 import fit
from calib.recorded.alignment import drift, segment_lags
from calib.recorded.poses import PoseInterval
from calib.recorded.table import ReferenceTable, SensorTable
from calib.recorded.tables import Making, Tables
from calib.signal.instrument import Instrument

RATE_HZ = 500.0
S = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
CLAMPED = clamp(np.radians(35), np.radians(30))
BESIDE = beside(np.eye(3), [0.0, 0.0, 9.81])


def motion(t: np.ndarray, m: int, order: int = 0) -> np.ndarray:
    """Sum of three sines a channel, 4 m/s2 each at most, or its derivative of an order."""
    frequencies = 2 * np.pi * np.array([1.3, 2.9, 5.7])
    phases = np.arange(3) + np.arange(m)[:, None]
    return np.stack([(4 * w**order * np.sin(np.outer(t, w) + p + order * np.pi / 2)).sum(1)
                     for p in phases for w in [frequencies]], axis=1)  # fmt: skip


def windows(pose: Pose, lag_s: float, rate: float, seed: int = 1, seconds: float = 60.0) -> list[Window]:
    m = pose.direction.shape[1]
    t = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    felt = t - lag_s - rate * (t - t.mean())
    V = (motion(felt, m) @ pose.direction.T + pose.gravity_mps2) @ S.T
    V += 0.02 * np.random.default_rng(seed).normal(size=V.shape)
    return motion_windows(pose, Points(t, V, motion(t, m), motion(t, m, 1)))


@pytest.mark.parametrize("pose", [CLAMPED, BESIDE], ids=["uniaxial", "tri-axial"])
def test_lag_and_drift_are_found(pose: Pose) -> None:
    found = drift(windows(pose, 2e-3, 30e-6))
    assert found is not None
    assert found.significant
    assert found.time_s == pytest.approx(30.0, abs=0.1)
    # Third order of omega lag: 2 ms at 6 Hz leave 0.2 % of it.
    assert found.lag_s + found.rate * (30.0 - found.time_s) == pytest.approx(2e-3, rel=5e-3)
    assert found.rate == pytest.approx(30e-6, abs=5 * found.u_rate + 1e-7)


def test_a_constant_lag_is_no_drift() -> None:
    found = drift(windows(CLAMPED, 2e-3, 0.0))
    assert found is not None
    assert not found.significant
    assert abs(found.rate) < 5 * found.u_rate


@pytest.mark.slow
def test_stated_uncertainties_are_those_of_the_scatter() -> None:
    # 60 recordings: the ratio of scatter to stated u is within the 99.9 % band of chi with 59 degrees of freedom.
    z_lag, z_rate = [], []
    for seed in range(60):
        made = windows(CLAMPED, 0.0, 0.0, seed, 10.0)
        lags = np.concatenate([segment_lags(w) for w in made])
        z_lag.append(lags[:, 1] / lags[:, 2])
        found = drift(made)
        assert found is not None
        z_rate.append(found.rate / found.u_rate)
        assert found.u_rate > 3e-7  # so that noise alone exceeds LEAST_RATE now and then
        assert not found.significant
    assert 0.72 < np.std(z_rate) < 1.32
    assert 0.92 < np.std(np.concatenate(z_lag)) < 1.08  # 1200 segments


def test_too_little_motion_tells_nothing() -> None:
    assert drift([]) is None
    assert drift(windows(CLAMPED, 0.0, 0.0, seconds=2.0)) is None


def test_motion_along_one_axis_of_three_is_enough() -> None:
    t = np.arange(5000) / RATE_HZ
    u, du, felt = (np.pad(motion(x, 1, k), ((0, 0), (0, 2))) for x, k in ((t, 0), (t, 1), (t - 2e-3, 0)))
    V = felt @ S.T + 0.02 * np.random.default_rng(3).normal(size=felt.shape)
    [window] = motion_windows(BESIDE, Points(t, V, u, du))
    lags = segment_lags(window)
    assert len(lags) == len(window.sums.count)
    np.testing.assert_allclose(lags[:, 1], 2e-3, atol=5 * lags[:, 2].max())


def test_a_window_at_rest_has_no_lag() -> None:
    [window] = windows(CLAMPED, 0.0, 0.0, seconds=10.0)
    window.sums.scatter[:, :2, :] = 0.0
    window.sums.scatter[:, :, :2] = 0.0
    assert len(segment_lags(window)) == 0


def tables(ppm: float) -> tuple[SensorTable, ReferenceTable, list[PoseInterval]]:
    """Three minutes in three positions; the reference's stamps are a perfect grid of a clock that runs fast."""
    rng = np.random.default_rng(5)
    t = np.arange(int(180 * RATE_HZ)) / RATE_HZ
    poses = [clamp(np.radians(35), np.radians(a)) for a in (0, 120, 240)]
    parts = zip(np.split(t, 3), poses, strict=True)
    V = np.concatenate([(motion(part, 1) @ p.direction.T + p.gravity_mps2) @ S.T + 0.1 for part, p in parts])
    V += 0.01 * rng.normal(size=V.shape)
    sensor = SensorTable("sensor.csv", t, V)
    reference = ReferenceTable("reference.csv", t * (1 + ppm * 1e-6), motion(t, 1), "acceleration", "a")
    return sensor, reference, [PoseInterval(60.0 * k, 60.0 * (k + 1), p) for k, p in enumerate(poses)]


@pytest.mark.slow
def test_free_running_clocks_cost_nothing_once_aligned() -> None:
    sensor, reference, poses = tables(40.0)  # 7 ms apart in the end
    front = Tables(sensor, reference, poses, Instrument())
    drifted = drift(front.windows())
    assert drifted is not None
    lag_s = drifted.lag_s
    # The reference's stamps run ahead: the sensor's lag behind them less and less.
    assert front.rate == pytest.approx(-40e-6, abs=5e-7)
    aligned = fit(front.windows(lag_s))
    as_they_are = fit(Tables(sensor, reference, poses, Instrument(), Making(align=False)).windows(lag_s))
    assert aligned.residual_sd.max() < 0.015 < 0.1 < as_they_are.residual_sd.max()
    assert np.abs(aligned.calibration.sensitivity - S).max() < 5e-4
    assert np.abs(as_they_are.calibration.sensitivity - S).max() > 1e-3


def test_clocks_in_step_are_left_alone() -> None:
    front = Tables(*tables(0.0), Instrument())
    front.windows()
    assert front.rate == 0.0


# Minutes of motion up to a frequency in Hz, by how many ppm the sensor's clock is slow, and its lag in s.
APART = {
    "a lag": (4, 20.0, 20.0, -0.02),
    "a tenth of a second": (12, 8.0, 150.0, 0.01),
    "in step": (4, 20.0, 0.0, 0.02),
}


@pytest.mark.two_cases
@pytest.mark.parametrize("reference", ["dc", pytest.param("ac", marks=pytest.mark.thorough)])
@pytest.mark.parametrize(
    ("minutes", "to_hz", "ppm", "lag_s"),
    [
        pytest.param(*values, id=name, marks=[pytest.mark.thorough] if values[0] > 10 else [])
        for name, values in APART.items()
    ],
)
def test_clocks_that_run_apart_beside_a_lag(
    minutes: int, to_hz: float, ppm: float, lag_s: float, reference: str
) -> None:
    """A lag of half a period of the fastest motion, or clocks that are half a period apart in the end: what windows
    tell of the lag is of first order in it, and of twice the size here."""
    rng, rate_hz, length = np.random.default_rng(7), 100.0, 10.0 * minutes
    t = np.arange(round(6 * length * rate_hz)) / rate_hz
    lines = np.fft.rfft(rng.normal(size=len(t)))
    at_hz = np.fft.rfftfreq(len(t), 1.0 / rate_hz)
    lines[(at_hz < 1.0) | (at_hz > to_hz)] = 0.0
    lines /= np.fft.irfft(lines, len(t)).std()
    a = np.fft.irfft(lines, len(t))
    shown = np.fft.irfft(lines / (1.0 + 0.1 / (1j * np.maximum(at_hz, 1e-9))), len(t)) if reference == "ac" else a
    ways = np.vstack([np.eye(3), 0.6 * np.eye(3) + 0.8 * np.roll(np.eye(3), 1, axis=1)])
    poses = [
        {"start_s": k * length + 1, "stop_s": (k + 1) * length - 1, **dict(zip(("dx", "dy", "dz"), d, strict=True)),
         "gx": 0.0, "gy": 0.0, "gz": 9.81}
        for k, d in enumerate(ways.tolist())
    ]  # fmt: skip
    felt = a[:, None] * ways[np.minimum(t // length, 5).astype(int)] + [0.0, 0.0, 9.81]
    V = felt @ S.T + 0.1 + 0.01 * rng.normal(size=(len(t), 3))
    ac = {"reference_coupling": "ac", "reference_corner_hz": 0.1} if reference == "ac" else {}
    found = calibrate(((t + lag_s) * (1.0 + ppm * 1e-6), V), {"time_s": t, "a": shown}, poses=poses, **ac)
    assert found.status == "valid", found.reasons
    u = found.standard_uncertainty.ravel()[:9].reshape(3, 3)
    assert (np.abs(found.sensitivity - S) < 4.0 * u).all()
    assert (np.diag(u) < 2e-3).all()
