"""Traffic beside a sustained motion: what is proportional is taken, what slips is refused as without traffic."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from benchmarks.traffic import (
    REFERENCE_NOISE_MPS2,
    SUSTAINED_HZ,
    WINDOW_S,
    Fault,
    rattles,
    signals,
    slips,
    sound,
    window,
)
from calib.excitation.sustained import sustained_hz


# In windows 14 and 18 the sustained motion is so weak that it is calm compared with the shocks.
@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 14, 18])
def test_a_firm_sensor_behind_a_filter_is_taken_beside_traffic(seed: int) -> None:
    (found,) = window(seed)
    assert found.used, found.reason
    assert found.stop_s - found.start_s > 0.9 * WINDOW_S
    assert found.numbers["nonlinearity_pct"] < 0.5  # of the filter: 3 to 28 % in the band of the shocks


@pytest.mark.one_case
@pytest.mark.parametrize("shocks", [0, 10], ids=["alone", "beside traffic"])
@pytest.mark.parametrize("fault", [partial(slips, 0.8), partial(slips, 2.5), partial(rattles, 10.0)])
def test_a_loose_sensor_is_refused_beside_traffic_as_well(fault: Fault, shocks: int) -> None:
    assert not any(found.used for found in window(1, fault, shocks=shocks))


def test_the_band_that_lasts_is_told_only_beside_shocks() -> None:
    for seed in range(4):
        _, u = signals(seed)
        lasting_hz = sustained_hz(u, 200.0)
        assert lasting_hz is not None
        assert SUSTAINED_HZ[1] < lasting_hz < 1.3 * SUSTAINED_HZ[1]
        _, alone = signals(seed, sound, shocks=0)
        assert sustained_hz(alone, 200.0) is None
        noise = REFERENCE_NOISE_MPS2 * np.random.default_rng(seed).normal(size=u.shape)
        assert sustained_hz(noise, 200.0) is None
        # Shocks alone, such as those of a hammer: nothing lasts beside them.
        assert sustained_hz(u * (np.abs(u).max(axis=1) > 0.2)[:, None] + noise, 200.0) is None
