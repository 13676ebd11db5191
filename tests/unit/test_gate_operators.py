"""The gate: its policies, what operators and lost devices do to it, and its state."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from agent.config.gate import DriftOptions, GateSettings
from agent.core.gate import CommandEffect, Gate
from agent.core.snapshot import pack, unpack
from calib.drift.drift import DriftSettings
from tests.gate_rules import (
    FAR,
    NEAR,
    NOMINAL,
    calibration,
    consistent,
    gate,
    held,
    jumped,
    scaled,
    valid,
)

# --- policies


def test_propose_puts_nothing_in_force_but_what_an_operator_accepts() -> None:
    g = gate(policy="propose")
    taken = g.judge(consistent(), NEAR)
    assert (taken.action, taken.in_force, taken.propose, taken.status) == ("take", False, True, "COLLECTING")
    g.published(5)
    adopted = held(scaled(1.04), g)
    assert (adopted.action, adopted.in_force, adopted.propose) == ("adopt", False, True)
    g.published(9)
    assert g.accept(5, "key").calibration is NEAR
    assert g.status == "VALID"


def test_observe_neither_changes_nor_proposes_and_tells_what_it_sees() -> None:
    """The state goes on unseen: innovations against one that stood still would not be independent of each other."""
    g = valid(policy="observe")
    taken, adopted, beyond = g.judge(consistent(), NEAR), held(scaled(1.04), g), held(FAR, g)
    assert [d.action for d in (taken, adopted, beyond)] == ["take", "adopt", "hold"]
    assert not any(d.in_force or d.propose for d in (taken, adopted, beyond))
    assert [d.status for d in (taken, adopted, beyond)] == ["VALID", "RECALIBRATING", "HELD"]
    assert taken.reason == "consistent with the calibration so far; not put in force (policy observe)"
    assert beyond.numbers["change_main_pct"] == pytest.approx(6.0)


# --- operators and devices


def test_on_hold_nothing_changes_until_released() -> None:
    g = valid()
    assert g.hold("key").status == "HELD"
    decision = g.judge(consistent(), NEAR)
    assert (decision.action, decision.in_force, decision.status) == ("refuse", False, "HELD")
    assert g.release("key").status == "VALID"
    assert g.judge(consistent(), NEAR).in_force


def test_rolled_back_it_stays_so_until_released() -> None:
    g, before = valid(), scaled(0.9)
    answer = g.rollback(before, "key-2")
    assert answer.calibration is before
    assert (answer.status, answer.reason) == ("VALID", "rolled back by key-2; on hold until an operator releases it")
    assert g.judge(consistent(), NEAR).action == "refuse"
    g.release("key-2")
    assert g.judge(consistent(), NEAR).action == "hold"  # 11 % from the anchor now
    assert g.judge(consistent(), scaled(0.91)).action == "take"


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (lambda g: g.accept(3, "k"), "estimate 3 cannot be accepted; estimates that can be: 70, 71"),
        (lambda g: g.accept(0, "k"), "estimate 0 cannot be accepted"),
        (lambda g: g.release("k"), "not on hold"),
        (lambda g: g.rollback(calibration(NOMINAL * np.nan), "k"), "S and Q must be finite"),
    ],
)
def test_commands_without_sense_are_refused_and_change_nothing(
    command: Callable[[Gate], CommandEffect], why: str
) -> None:
    g = valid()
    for number in (70, 71):
        g.judge(consistent(), FAR)
        g.published(number)
    g.judge(consistent(), FAR)  # proposed, not yet published
    before = g.snapshot()
    answer = command(g)
    assert why in answer.refused
    assert answer.calibration is None
    assert pack(g.snapshot()) == pack(before)


def test_a_second_hold_is_refused() -> None:
    g = valid()
    g.hold("first")
    before = g.snapshot()
    assert g.hold("second").refused == "the calibration is on hold already"
    assert pack(g.snapshot()) == pack(before)


def test_a_lost_sensor_is_invalid_and_comes_back_to_what_it_was() -> None:
    for g, back in ((gate(), "UNCALIBRATED"), (valid(), "VALID")):
        g.judge(jumped(), FAR)
        assert g.lose("unplugged").status == "INVALID"
        answer = g.regain("speaks again")
        assert (answer.status, answer.reason) == (back, "speaks again")
        assert g.judge(jumped(), FAR).held == 1  # the one before is forgotten


def test_the_state_is_plain_and_comes_back_bit_for_bit() -> None:
    g = valid(policy="propose")
    held(FAR, g, 6)
    g.published(12)
    again = Gate(GateSettings(policy="propose"), scaled(1.5))
    again.load(unpack(pack(g.snapshot())))
    assert pack(again.snapshot()) == pack(g.snapshot())
    accepted = again.accept(12, "key").calibration
    assert accepted is not None
    assert np.array_equal(accepted.sensitivity, FAR.sensitivity)


def test_drift_options_reach_the_test() -> None:
    assert DriftOptions().settings() == DriftSettings()
    assert DriftOptions(false_alarms_a_year=1, windows_a_year=10).settings() == DriftSettings(0.5, 10)
