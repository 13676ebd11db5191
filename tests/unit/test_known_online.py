"""Known filters on-line: stated in the configuration of a channel, divided out window by window."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from agent.core.events import CalibrationUpdate
from benchmarks.online.node import Stated, Timing, node
from benchmarks.online.runner import visits
from hw.virtual.building import Building
from tests.pair import flat, lowpass
from tests.unit.test_response_online import BROAD, SEED, newest

WINDOWS = 6
NEAR = lowpass(2, 14.0)  # the motion ends at 12 Hz
NEAR_TEXT = ["lowpass order=2 corner_hz=14 u_corner_pct=2"]


@cache
def told(where: str, *, stated: bool) -> CalibrationUpdate:
    """The calibration in force after some windows; the filter is in the sensor or in the reference."""
    drawn = node(SEED, all_axes=True, stated=Stated(lag_s=0.01), timing=Timing(20.0, 60.0, WINDOWS))
    parameters = replace(drawn.building.parameters, band=BROAD)
    if where:
        parameters = replace(parameters, **{where: replace(getattr(parameters, where), response=NEAR)})
    filters: dict[str, Any] = {"prior": ["flat"], "certificate": ["flat"]}
    if where:
        filters["prior" if where == "sensor" else "certificate"] = NEAR_TEXT
    config = drawn.config
    if stated:
        (channel,) = config.channels
        sections = {
            name: getattr(channel, name).model_copy(update={"filters": tuple(of)}) for name, of in filters.items()
        }
        config = config.model_copy(update={"channels": (channel.model_copy(update=sections),)})
    return newest(replace(drawn, config=config), visits(Building(parameters, SEED), range(WINDOWS)))


@pytest.mark.parametrize("where", ["sensor", "reference"])
def test_a_near_filter_that_is_stated_changes_neither_s_nor_q(where: str) -> None:
    found, without = told(where, stated=True), told("", stated=True)
    assert found.windows == without.windows >= WINDOWS - 1
    gain = abs(NEAR(np.array([found.reference_frequency_hz]))[0]) if where == "sensor" else 1.0
    S, wanted = np.array(found.sensitivity), gain * np.array(without.sensitivity)
    assert np.abs(S - wanted).max() < 5e-4
    assert np.abs(np.array(found.offset) - without.offset).max() < 0.006
