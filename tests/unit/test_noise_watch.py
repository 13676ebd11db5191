"""Noise that grows is told within three windows; residuals that grow with the motion are not called noise."""

from __future__ import annotations

import re

import numpy as np
import pytest

from agent.core.noise_watch import FIRST, IN_A_ROW, NoiseWatch
from agent.core.snapshot import pack, unpack
from benchmarks.noise import Sound, told
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.unit.test_estimation import estimation, hours

LEVELS_MPS2 = np.geomspace(0.02, 0.2, 8)


@pytest.mark.slow
def test_noise_that_doubles_is_told_within_three_windows_and_so_is_its_end() -> None:
    """A window that moves more than nearly all of the first ones would tell less."""
    random, found = np.random.default_rng(1), estimation()

    def said(count: int, first: int, noise_mps2: float) -> list[str]:
        levels = random.choice(LEVELS_MPS2[:-2] if noise_mps2 > 0.005 else LEVELS_MPS2, size=(count, 1)) * np.ones(3)
        windows = [building_window(random, level_mps2=tuple(own), noise_mps2=noise_mps2) for own in levels.tolist()]
        return [judged.news for judged in hours(found, windows, first=first)]

    assert not any("noise" in news for news in said(FIRST + 6, 0, 0.005))
    again = estimation()
    again.load(unpack(pack(found.snapshot())))
    found = again
    grown = said(IN_A_ROW, FIRST + 6, 0.01)
    assert [bool(news) for news in grown] == [False, False, True]
    for axis in "xyz":
        assert f"the noise of output {axis} has grown: 0.0" in grown[-1]
    [*sizes] = map(float, re.findall(r"has grown: (\S+) m/s2", grown[-1]))
    [*times] = map(float, re.findall(r"windows (\S+) times", grown[-1]))
    assert sizes == pytest.approx([0.01] * 3, rel=0.05)  # 3000 points tell it to 1.3 %
    assert times == pytest.approx([2.0] * 3, rel=0.1)
    assert not any(said(6, FIRST + 9, 0.01))
    back = said(IN_A_ROW, FIRST + 15, 0.005)
    assert [bool(news) for news in back] == [False, False, True]
    assert "the noise of output x is as it was before: 0.00" in back[-1]


@pytest.mark.parametrize("part", [0.0, 0.02, 0.5])
def test_residuals_that_grow_with_the_motion_are_no_noise(part: float) -> None:
    """A month of windows an hour; the level of the motion varies by 10. `python -m benchmarks.noise`: years."""
    assert told(np.random.default_rng(2), Sound(10.0, part, 0.1), np.ones(720)) == []


def test_a_storm_after_calm_windows_is_no_noise() -> None:
    """Ten times more motion than in all windows before, and residuals of a tenth of it."""
    random, watch = np.random.default_rng(3), NoiseWatch()
    for level in [0.02] * FIRST + [0.2] * 5:
        window = building_window(random, level_mps2=(level, level, level), reference_noise_mps2=0.1 * level)
        assert watch.update(Record.of(window, 0.0), 1.0) == ""
