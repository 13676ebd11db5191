"""The front end that files and live streams share."""

from __future__ import annotations

import numpy as np
import pytest

from calib.excitation.front_end import Aligned, aligned
from calib.model import Array
from calib.signal.instrument import Instrument
from calib.signal.samples import Samples
from calib.signal.stamps import clock_from_stamps

RATE_HZ, SECONDS = 200.0, 40.0
SPAN_S = (5.0, 35.0)


def pair(missing: int | None) -> Aligned:
    """A sensor beside a noisy uniaxial reference; one sample of the reference may be missing."""
    random = np.random.default_rng(4)
    t = np.arange(int(SECONDS * RATE_HZ)) / RATE_HZ
    a = sum((np.sin(2.0 * np.pi * f * t + f) for f in (1.1, 2.3, 4.7)), np.zeros(len(t)))
    clock = clock_from_stamps(t)
    V: Array = np.outer(a, [1.0, 0.1, -0.2]) + 0.01 * random.normal(size=(len(t), 3))
    u: Array = (a + 0.05 * random.normal(size=len(t)))[:, None]
    if missing is not None:
        u[missing] = np.nan
    sensor, reference = Samples("sensor", 0, V, clock), Samples("reference", 0, u, clock)
    found = aligned(sensor, reference, Instrument(), SPAN_S)
    assert found is not None
    return found


def test_one_missing_reference_sample_leaves_band_and_noise_as_they_are() -> None:
    whole, holed = pair(None), pair(int(20.0 * RATE_HZ))
    assert whole.band_hz is not None
    assert holed.band_hz == pytest.approx(whole.band_hz, rel=0.1)
    np.testing.assert_allclose(holed.reference_noise, whole.reference_noise, rtol=0.1)
    assert len(holed.points.time_s) > 0.9 * len(whole.points.time_s)
