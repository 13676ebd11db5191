"""What a change of S looks like: a turn, another scale of an output or of all, or none of these; from windows alone."""

from __future__ import annotations

import re

import numpy as np
import pytest

from agent.core.hypotheses import shape_of_change
from benchmarks.hypotheses import MEAN, PRIORS, U, limit
from calib.estimate.wander import TemperatureModel, Wander
from calib.state.state import State
from calib.windows.record import Record
from hw.virtual.schedule import rotation
from tests.building_windows import building_window

BEFORE, AFTER, HOUR_DAYS = 6, 5, 1.0 / 24.0
AXIS = np.array([-0.48, 0.6, 0.64])
S = np.array([[1.01, 0.006, -0.004], [0.003, 0.99, 0.005], [-0.006, 0.002, 1.02]])


def said(change: np.ndarray) -> str:
    """Of S `change` after some windows."""
    random = np.random.default_rng(5)
    state = State(MEAN, U, PRIORS, Wander(), TemperatureModel(), fixed=True)
    state.meet("A")
    for k in range(BEFORE + AFTER):
        now = S if k < BEFORE else S + change
        window = building_window(random, level_mps2=(0.3, 0.3, 0.3), S=now)
        state.update(Record.of(window, k * HOUR_DAYS, reference="A", to_hz=state.motion_to_hz))
    return shape_of_change(state, BEFORE * HOUR_DAYS, np.eye(3), limit)


def test_a_turn_is_told_with_its_angle_and_axis() -> None:
    told = said(S @ rotation(AXIS, np.deg2rad(0.3)).T - S)  # what it feels turns the other way
    words = "the change of S looks like a turn of the sensor against its reference by"
    found = re.match(rf"{words} ([\d.]+) deg about ", told)
    assert found is not None
    assert float(found[1]) == pytest.approx(0.3, abs=0.03)
    axis = np.array([float(x) for x in re.findall(r"-?[\d.]+", told.split("about (")[1].split(")")[0])])
    assert axis @ AXIS > 0.99
    assert " or " not in told


def test_one_output_and_a_channel_of_the_reference_along_it_look_alike() -> None:
    told = said(np.diag([0.0, -0.005, 0.0]) @ S)
    found = {words: float(size) for size, words in re.findall(r"([-+][\d.]+) % in (.*?)(?= or | \()", told)}
    near = 3.0 * 0.5 / np.sqrt(float(told.split(", ")[-1].split()[0]))  # u by chi-squared without a change
    expected = {"output y of the sensor": -0.5, "channel y of the reference": 0.5}
    assert found == pytest.approx(expected, abs=near)
    assert near < 0.1
    assert "turn" not in told


def test_all_outputs() -> None:
    found = re.match(r"the change of S looks like ([-+][\d.]+) % in all outputs \(", said(0.005 * S))
    assert found is not None
    assert float(found[1]) == pytest.approx(0.5, abs=0.05)


@pytest.mark.slow
def test_what_is_none_of_these_is_not_called_one() -> None:
    assert said(np.array([[0.0, 0.0, 0.01], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])) == ""
    assert said(np.zeros((3, 3))) == ""
