"""Outputs that are exchanged, inverted or of another scale are named, and what the status advises works on the case."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from agent.core import explaining
from agent.core.estimation import DAY_S, Estimation
from agent.core.exchanges import Exchange
from agent.core.hypotheses import possible_jump
from agent.core.snapshot import pack, unpack
from benchmarks.exchanges import BEFORE, CASES, EYE, LEVELS, changed, explained, record_of, settled
from calib.excitation.front_end import windows_of
from calib.model import Array, Pose
from calib.signal.instrument import Instrument
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.clamp_windows import Q_TRUE, S_TRUE
from tests.unit.test_estimation import actions, channel_of, estimation, hours
from tests.unit.test_holes import SPAN_S, pair

HELD = 3  # windows that confirm a change
UTC_NS = 1_790_000_000_000_000_000  # 2026-09-21 14:13 UTC
QUARTER = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about z


@cache
def before() -> bytes:
    return pack(settled(np.random.default_rng(1), windows=4).snapshot())


def again(state: bytes, **more: Any) -> Estimation:
    found = estimation(gate={"confirm_windows": HELD}, **more)
    found.load(unpack(state))
    return found


def held(*causes: Exchange) -> tuple[Estimation, str]:
    """The estimation after held windows, and what it tells at the next tick."""
    found, random = again(before()), np.random.default_rng(2)
    first = BEFORE + HELD - len(causes)
    for k, judged in enumerate(hours(found, [changed(random, cause) for cause in causes], first=first)):
        assert judged.decision.action == "hold"
        if judged.decision.proposal is not None:
            found.gate.published(100 + k)
    return found, found.explain((BEFORE + HELD) / 24 * DAY_S, UTC_NS)


def test_an_ac_coupled_reference_in_another_unit_is_undone_with_its_integral() -> None:
    """Before, held windows beside an AC-coupled reference ended the estimation of the channel."""
    sensor, reference = pair(1, "")
    poses, found = Pose("beside", np.eye(3), np.zeros(3)), []
    for factor in (1.0, 0.5):
        u = replace(reference, values=factor * reference.values)
        [window] = windows_of(poses, sensor, u, Instrument(corner_hz=0.05), SPAN_S)
        found.append(Record.of(window, 0.0))
    whole, halved = found
    assert halved.channels == 6
    undone = Exchange(0.5 * EYE, "reference").undone(halved, np.eye(3), np.zeros(3))
    for one, other in ((undone.slopes, whole.slopes), (undone.root, whole.root), (undone.mean_x, whole.mean_x)):
        assert np.abs(one) == pytest.approx(np.abs(other), rel=1e-6, abs=1e-6 * np.abs(other).max())


def after(found: Estimation, windows: list[Any]) -> list[str]:
    return actions(hours(found, windows, first=BEFORE + HELD))


@pytest.mark.thorough
def test_another_range_is_named_at_once_and_both_that_is_advised_ends_it() -> None:
    doubled = Exchange(2.0 * EYE)
    found, told = held(Exchange(1.5 * EYE), *[doubled] * HELD)  # the first window saw both ranges
    # The first held window ends three hours before the tick.
    assert told.startswith(
        "3 held windows show one change, since 2026-09-21 11:13 UTC at the latest: all outputs of s are 2 times what "
        "they were (its range is another one, as after a loss of supply). Chi-squared is "
    )
    [number] = re.findall(
        r"Set s back to what it was; the next windows are then taken, and S and Q stay. Or put the change in force: "
        r"fieldcal command accept --sequence (\d+)$",
        told,
    )
    [chi2, without, other] = [float(x) for x in re.findall(r"(?:is|it,|it;) ([\d.e+]+) with", told)]
    assert chi2 < HELD * 33  # 12 numbers in each window: the 99.9 % point
    assert chi2 + 10.0 < other < without
    now = pack(found.snapshot())
    random = np.random.default_rng(3)
    assert after(found, [building_window(random, level_mps2=LEVELS) for _ in range(3)]) == ["take"] * 3
    assert found.gate.status == "VALID"
    u = found.in_force.standard_uncertainty
    assert (u < 1.02 * again(before()).in_force.standard_uncertainty).all()  # what was held is no drift of S

    found = again(now)
    answer = found.gate.accept(int(number), "key")
    assert answer.refused == ""
    assert answer.calibration is not None
    found.accept(answer.calibration)
    assert after(found, [changed(random, doubled) for _ in range(3)]) == ["take"] * 3
    away = np.append(found.in_force.sensitivity - 2.0 * S_TRUE, found.in_force.offset - 2.0 * Q_TRUE)
    u = found.in_force.standard_uncertainty
    assert np.abs(away / u).max() < 3.0
    assert u[[0, 4, 8]].max() < 0.01


@pytest.mark.thorough
def test_a_sensor_that_was_turned_on_its_mount_goes_on_with_the_rotation_that_is_advised() -> None:
    turned = Exchange(QUARTER, "mount")
    found, told = held(*[turned] * HELD)
    assert "s was turned on its mount, so that x shows what y showed, y shows minus what x showed" in told
    keys = dict(re.findall(r"(rotation\w*) = (\[[^]]*\])", told))
    stated: dict[str, Any] = {key: [float(x) for x in value[1:-1].split(",")] for key, value in keys.items()}
    assert set(stated) == {"rotation", "rotation_gravity_mps2"}
    found = again(pack(found.snapshot()), **stated)
    found.restate(None, remounted=True)
    pose = replace(
        building_window(np.random.default_rng(4)).pose, direction=np.reshape(stated["rotation"], (3, 3)),
        gravity_mps2=np.array(stated["rotation_gravity_mps2"]),
    )  # fmt: skip
    random = np.random.default_rng(5)
    assert after(found, [replace(changed(random, turned), pose=pose) for _ in range(4)]) == ["take"] * 4
    assert found.gate.status == "VALID"
    away, u = (found.in_force.sensitivity - S_TRUE).ravel(), found.in_force.standard_uncertainty[:9]
    assert np.abs(away / u).max() < 3.0
    assert u.max() < 0.01


@pytest.mark.parametrize(
    "name", ["range of 16 g in place of 4 g (LIS3DH)", "x and y of the sensor exchanged", "z of the reference inverted"]
)
def test_other_changes_are_named_first(name: str) -> None:
    """`python -m benchmarks.exchanges` does the same for more changes and seeds."""
    cause, *_ = explained(again(before()), np.random.default_rng(6), CASES[name], count=2)
    assert cause.of == CASES[name].of
    np.testing.assert_array_equal(cause.matrix, CASES[name].matrix)


@pytest.mark.parametrize("matrix", [1.05 * EYE, 1.6 * EYE, np.diag([0.0, 1.0, 1.0])], ids=["5 %", "60 %", "dead"])
def test_what_is_no_exchange_is_not_called_one(matrix: Array) -> None:
    assert explained(again(before()), np.random.default_rng(7), Exchange(matrix), count=2) == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("cause", "words", "not_advised"),
    [
        # Noise, and a hundredth of the motion.
        (Exchange(np.diag([0.01, 1.0, 1.0])), "output x is dead: its largest sensitivity is 0.01", "accept"),
        # The certificate may state 50 % at most.
        (Exchange(1.6 * EYE, "reference"), "another reference sensitivity (reference_", "u_sensitivity_pct"),
    ],
    ids=["dead", "60 %"],
)
def test_nothing_is_advised_that_would_be_refused(cause: Exchange, words: str, not_advised: str) -> None:
    found = again(before())
    record = record_of(found, np.random.default_rng(8), cause, BEFORE)
    jump = possible_jump(found.state, [record])
    told = explaining.explained(found.state, [record], jump, found.gate, channel_of(), None)
    assert words in told
    assert not_advised not in told
