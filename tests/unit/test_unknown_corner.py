"""An AC-coupled instrument whose corner nobody states, near the motion: an IEPE accelerometer on a slow structure."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from calib import calibrate
from calib.model import Array
from calib.recorded.calibrating import CORNERS_ALIKE
from tests.pair import Filter, flat, highpass

RATE_HZ, SECONDS, G_MPS2 = 100.0, 240.0, 9.81
BAND_HZ = (0.6, 8.0)
ALONG = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def beside(seed: int, of_reference: Filter, of_sensor: Filter, *ac: str, **stated: Any) -> tuple[Any, Array]:
    """What is told of a sensor beside a tri-axial reference, and the true S. `ac`: which of both are AC-coupled."""
    random = np.random.default_rng([93, seed])
    n = round(RATE_HZ * SECONDS)
    hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    lines = np.fft.rfft(random.standard_normal((n, 3)), axis=0)
    lines[(hz < BAND_HZ[0]) | (hz > BAND_HZ[1])] = 0.0
    hz[0] = 1e-9
    x, felt = (np.fft.irfft(lines * own(hz)[:, None], n, axis=0) for own in (of_reference, of_sensor))
    S = np.eye(3) + np.where(np.eye(3), 0.03, 0.01) * random.standard_normal((3, 3))
    g = np.array([0.0, 0.0, G_MPS2])
    V = (felt + g * ("sensor" not in ac)) @ S.T + 0.1 + 0.003 * random.standard_normal((n, 3))
    x = (x + g * ("reference" not in ac)) * (1.0 + 1e-3 * random.standard_normal(3))
    at_s = np.arange(n) / RATE_HZ
    table = {"time_s": at_s} | {f"a{axis}": x[:, k] for k, axis in enumerate("xyz")}
    coupled = {"coupling": "sensor", "reference_coupling": "reference"}
    stated |= {option: "ac" if name in ac else "dc" for option, name in coupled.items()}
    return calibrate((at_s + 0.003, V), table, rotation=ALONG, gravity=G_MPS2, **stated), S


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("times", [2.0, pytest.param(4.0, marks=pytest.mark.thorough)])
def test_what_the_corner_of_a_reference_does_is_not_the_sensors(times: float, order: int) -> None:
    """The corner is at a half or a quarter of the motion's lower end, so that the reference shows up to 1.9 % too
    little at the frequency of S. 2 recordings."""
    largest = []
    for seed in range(2):
        told, S = beside(seed, highpass(BAND_HZ[0] / times, order), flat, "reference")
        assert told.status == "valid", told.reasons
        assert not told.warnings
        error = (told.sensitivity - S) / told.standard_uncertainty[:9].reshape(3, 3)
        assert told.standard_uncertainty[[0, 4, 8]].max() < 2.5e-3
        largest.append(np.abs(error).max())
    assert max(largest) < 3.5


@pytest.mark.slow
def test_what_the_corner_of_a_sensor_does_is_in_its_s() -> None:
    """The reference responds to constants: the sensor shows less at the frequency of S, and S says so."""
    corner = highpass(BAND_HZ[0] / 2.0)
    told, S = beside(1, flat, corner, "sensor")
    assert told.status == "valid", told.reasons
    S = S * abs(corner(np.array([told.reference_frequency_hz]))[0])
    error = (told.sensitivity - S) / told.standard_uncertainty[:9].reshape(3, 3)
    assert np.abs(error).max() < 3.5


@pytest.mark.slow
def test_two_corners_that_nothing_tells_apart_are_a_warning() -> None:
    corner = highpass(BAND_HZ[0] / 4.0)
    told, _ = beside(2, corner, corner, "sensor", "reference")
    assert CORNERS_ALIKE in told.warnings
    corners = {"reference_corner_hz": 0.15, "sensor_corner_hz": 0.15}
    told, _ = beside(2, corner, corner, "sensor", "reference", **corners)
    assert CORNERS_ALIKE not in told.warnings


@pytest.mark.slow
@pytest.mark.parametrize("feels", [False, True])
def test_a_reference_without_gravity_responds_to_constants_where_the_sensor_shows_none(feels: bool) -> None:
    """Nobody states the coupling. Beside a sensor that shows gravity, Q would contain it; else Q is determined."""
    random = np.random.default_rng(95)
    a = np.cumsum(random.standard_normal((6000, 3)), axis=0) * 0.02
    a -= a.mean(axis=0)
    V = a + [0.1, -0.2, 0.1 + G_MPS2 * feels] + 0.002 * random.standard_normal(a.shape)
    at_s = np.arange(len(a)) / RATE_HZ
    told = calibrate(
        (at_s, V), {"time_s": at_s} | {f"a{axis}": a[:, k] for k, axis in enumerate("xyz")}, rotation=ALONG
    )
    assert told.status == "valid", told.reasons
    assert list(np.isfinite(told.offset)) == [not feels] * 3
    assert feels or np.abs(told.offset - [0.1, -0.2, 0.1]).max() < 0.02
