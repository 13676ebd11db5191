"""Two loggers whose clocks are seconds apart: the motion tells by how much, or the data are refused."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from calib import calibrate
from calib.model import Array
from calib.recorded.clock_offset import FURTHEST_S, clock_offset
from calib.recorded.outcome import Outcome

S = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
RATE_HZ, REFERENCE_HZ, SECONDS = 100.0, 125.0, 150.0
# From and to which frequency in Hz the motion goes: that of a shaker, and two modes of a structure.
BANDS_HZ = {"broad": ((2.0, 12.0),), "two modes": ((1.5, 2.0), (3.0, 3.5))}


@cache
def motion(bands: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Times in s of 1 kHz from -15 s on, and accelerations (n, 3) in m/s2 of these bands, 1 m/s2 rms on each axis."""
    t = np.arange(-15.0, SECONDS + 15.0, 1e-3)
    lines = np.fft.rfft(np.random.default_rng(seed).normal(size=(len(t), 3)), axis=0)
    at_hz = np.fft.rfftfreq(len(t), 1e-3)
    lines[~np.any([(at_hz > low) & (at_hz < high) for low, high in BANDS_HZ[bands]], axis=0)] = 0.0
    a = np.fft.irfft(lines, len(t), axis=0)
    return t, a / a.std(axis=0)


def beside(offset_s: float, ppm: float = 0.0, bands: str = "broad", other: int | None = None) -> Outcome:
    """What is found where the sensor's clock shows `offset_s` more than the reference's at its begin, and runs fast by
    `ppm`. `other`: the seed of the motion that the reference has instead."""
    random = np.random.default_rng(11)
    gravity = np.array([0.0, 0.0, 9.80665])

    def at(time_s: np.ndarray, seed: int) -> np.ndarray:
        t, a = motion(bands, seed)
        return np.column_stack([np.interp(time_s, t, x) for x in a.T]) + gravity

    sensor_s, reference_s = (np.arange(0.0, SECONDS, 1.0 / rate_hz) for rate_hz in (RATE_HZ, REFERENCE_HZ))
    V = at(sensor_s, 1) @ S.T + 0.01 * random.normal(size=(len(sensor_s), 3))
    a = at(reference_s, other or 1)
    return calibrate((sensor_s * (1.0 + 1e-6 * ppm) + offset_s, V), (reference_s, a), rotation=np.eye(3))


@pytest.mark.two_cases
@pytest.mark.parametrize(
    ("offset_s", "ppm", "bands"), [(1.7, 30.0, "broad"), (-6.3, 0.0, "broad"), (2.9, -100.0, "two modes")]
)
def test_clocks_that_are_seconds_apart_are_joined_and_this_is_told(offset_s: float, ppm: float, bands: str) -> None:
    found = beside(offset_s, ppm, bands)
    assert found.status == "valid", found.reasons
    assert found.more["clock_offset_s"] == pytest.approx(offset_s + 1e-6 * ppm * SECONDS / 2.0, abs=0.02)
    told = f"{abs(found.more['clock_offset_s']):.2f} s {'ahead of' if offset_s > 0 else 'behind'}"
    assert found.warnings[0].startswith(f"the clock of the sensor is {told} that of the reference")
    off = np.abs(found.sensitivity - S) / found.standard_uncertainty[:9].reshape(3, 3)
    assert off.max() < 4.0
    assert (found.standard_uncertainty[[0, 4, 8]] < 3e-3).all()


@pytest.mark.slow
def test_clocks_in_step_are_not_moved() -> None:
    found = beside(0.0)
    assert found.status == "valid"
    assert found.more["clock_offset_s"] == 0.0
    assert found.warnings == ()


@pytest.mark.slow
@pytest.mark.parametrize("bands", ["two modes", pytest.param("broad", marks=pytest.mark.thorough)])
def test_devices_that_do_not_move_together_are_refused(bands: str) -> None:
    found = beside(0.0, bands=bands, other=2)
    assert found.status == "refused"
    assert found.more["clock_offset_s"] == 0.0


def stretches(offset_s: float, bands: str, other: int, noise_mps2: float = 0.0) -> list[tuple[Array, Array, Array]]:
    """One stretch of both devices, whose outputs come `offset_s` later than the motion of this seed."""
    t, a = motion(bands, 1)
    _, u = motion(bands, other)
    time_s = np.arange(0.0, SECONDS, 1.0 / RATE_HZ)
    V, u = (
        np.column_stack([np.interp(at_s, t, x) for x in of.T]) for at_s, of in ((time_s - offset_s, a), (time_s, u))
    )
    return [(time_s, V + noise_mps2 * np.random.default_rng(5).normal(size=V.shape), u)]


@pytest.mark.parametrize("offset_s", [-9.5, -0.43, 3.21, 9.5])
@pytest.mark.parametrize("bands", BANDS_HZ)
def test_the_offset_of_the_pieces(offset_s: float, bands: str) -> None:
    # Noise of twice the motion; the offset is told to half a step of 10 ms.
    found = clock_offset(stretches(offset_s, bands, 1, 2.0), SECONDS, 2e-4, 0.02)
    assert found is not None
    assert found[0] == pytest.approx(offset_s, abs=0.012)
    assert found[1] == 0.0


def test_beyond_the_furthest_offset_nothing_is_told() -> None:
    assert clock_offset(stretches(FURTHEST_S + 2.0, "broad", 1), SECONDS, 2e-4, 0.02) is None


@pytest.mark.one_case
@pytest.mark.parametrize("bands", BANDS_HZ)
def test_pieces_of_another_motion_do_not_agree(bands: str) -> None:
    for other in range(2, 22):
        assert clock_offset(stretches(0.0, bands, other), SECONDS, 2e-4, 0.02) is None


def test_one_piece_and_no_motion_tell_nothing() -> None:
    (time_s, V, u), *_ = stretches(3.0, "broad", 1)
    assert clock_offset([(time_s[:3000], V[:3000], u[:3000])], 30.0, 2e-4, 0.02) is None
    assert clock_offset([(time_s, 0.0 * V, 0.0 * u)], SECONDS, 2e-4, 0.02) is None
