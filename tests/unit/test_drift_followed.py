"""A drift that the test found: the state gets its rate, and U covers the time since its onset."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agent.core.snapshot import pack, unpack
from benchmarks.online.lorries import after, window
from calib.estimate.nuisances import Priors
from calib.estimate.wander import TemperatureModel, Wander
from calib.state.state import State
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.clamp_windows import G_MPS2, Q_TRUE, S_TRUE

MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.where(np.eye(3).ravel() > 0, 0.05, 0.03), np.full(3, 20.0))
SYY, QX = 4, 9
RATE = 3e-4  # of S_yy a day: 11 % a year
EXACT: dict[str, Any] = {"level_mps2": (0.0, 0.5, 0.0), "noise_mps2": 0.001}
PRIORS = Priors(reference=1e-3, offset_mps2=1e-3, lag_window_s=0.0)


def told_of_a_drift(days: range, u_rate: np.ndarray) -> State:
    """Ten windows without drift, then the drift is told and a window comes each of `days`."""
    random = np.random.default_rng(1)
    found = State(
        MEAN, U, PRIORS, Wander({**Wander.none().values, "offset_rate_mps2": 1e-9}), TemperatureModel(), fixed=True
    )
    for k in range(10):
        found.update(Record.of(building_window(random, **EXACT), 0.1 * k))
    found.step(found.changes(np.where(np.arange(12) == SYY, RATE, 0.0), u_rate=u_rate))
    for day in days:
        Q = Q_TRUE + np.array([1e-3 * day, 0.0, 0.0])
        found.update(Record.of(building_window(random, S=drifted(day), Q=Q, **EXACT), day))
    return found


def drifted(day: float) -> np.ndarray:
    S = S_TRUE.copy()
    S.flat[SYY] += RATE * day
    return S


def rates(*which: int) -> np.ndarray:
    return np.where(np.isin(np.arange(12), which), [*[RATE] * 9, *[1e-3] * 3], 0.0)


@pytest.mark.slow
def test_the_rates_are_recovered_and_q_and_s_go_on_with_them() -> None:
    found = told_of_a_drift(range(1, 30), rates(SYY, QX))
    rate, u = found.quantity("Syy_rate")
    assert abs(rate - RATE) < 3 * u < 0.1 * RATE
    rate, u = found.quantity("Qx_rate")
    assert abs(rate - 1e-3) < 3 * u < 5e-4
    assert {name for name in found.names() if name.endswith("_rate")} == {"Qx_rate", "Qy_rate", "Qz_rate", "Syy_rate"}
    later = found.law(129.0)
    u = np.sqrt(later.covariance[SYY, SYY])
    assert abs(later.mean[SYY] - drifted(129.0).flat[SYY]) < 3 * u < 4e-3


def test_as_long_as_no_window_tells_the_rate_u_grows_by_it() -> None:
    found = told_of_a_drift(range(0), rates(SYY))
    before, after = (found.law(day).covariance[SYY, SYY] for day in (0.9, 100.9))
    assert after - before == pytest.approx((100 * RATE) ** 2, rel=1e-9)


@pytest.mark.slow
def test_a_state_with_a_rate_of_s_goes_on_from_its_snapshot() -> None:
    found = told_of_a_drift(range(1, 5), rates(SYY))
    again = told_of_a_drift(range(0), rates())
    again.load(unpack(pack(found.snapshot())))
    window = Record.of(building_window(np.random.default_rng(2), S=drifted(40.0), **EXACT), 40.0)
    for state in (found, again):
        state.update(window)
    assert pack(again.snapshot()) == pack(found.snapshot())


@pytest.mark.parametrize(("share", "added_mps2"), [(0.0, 0.0), (0.005, 0.005 * G_MPS2), (np.inf, 1.47)])
def test_a_small_change_of_s_is_no_filter_that_takes_half_of_it(share: float, added_mps2: float) -> None:
    """S at 0 Hz times gravity is in Q of a mount that stays: U of Q grows by the change of S, not by 1.5 m/s2."""
    found = after([window(seed) for seed in range(4)])
    before = found.result().standard_uncertainty
    found.step(found.changes(np.zeros(12), another_filter=share))
    u = found.result().standard_uncertainty
    np.testing.assert_allclose(u[:9], before[:9], rtol=1e-6)  # S holds at its frequency, with any filter
    added = np.sqrt(max(u[11] ** 2 - before[11] ** 2, 0.0)) / found.scale
    assert added == pytest.approx(added_mps2, rel=0.03, abs=1e-6)
