"""`fieldcal calibrate` and the agent say the same of the same recordings, to a twentieth of u (benchmarks.online)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.online.agreement import LIMIT_U, Both, bench_day, building


@pytest.mark.parametrize("recording", [building, pytest.param(bench_day, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("seed", [3, pytest.param(5, marks=pytest.mark.nightly)])
def test_files_and_agent_agree(recording: Callable[[int], Both], seed: int) -> None:
    both = recording(seed)
    # A hole in one visit may cut it for the agent, which sees blocks, and not for the file, which sees stamps.
    assert abs(both.windows[0] - both.windows[1]) <= 1 <= min(both.windows) - 9
    assert np.isfinite(both.apart).sum() >= 8
    assert np.nanmax(both.apart) <= (LIMIT_U if both.windows[0] == both.windows[1] else 2.0 * LIMIT_U)
