"""The gate: what a window may change, and how far."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from agent.config.gate import GateSettings
from agent.core.anchor import Anchor, rotation_rad
from agent.core.gate import Evidence, Gate
from calib.model import Calibration
from tests.gate_rules import (
    DOF,
    FAR,
    LIMIT_AT_1E_4,
    NEAR,
    NOMINAL,
    SETTINGS,
    calibration,
    changed,
    consistent,
    gate,
    held,
    jumped,
    scaled,
    turned,
    valid,
)

# --- consistent windows


def test_a_consistent_window_is_taken_and_comes_in_force() -> None:
    g = gate()
    assert g.status == "UNCALIBRATED"
    decision = g.judge(consistent(), NEAR)
    assert (decision.action, decision.in_force, decision.propose, decision.status) == ("take", True, False, "VALID")
    assert decision.numbers["change_main_pct"] == pytest.approx(1.0)
    assert decision.numbers["change_main_pct_threshold"] == pytest.approx(5.0)


def test_too_little_determined_is_collecting() -> None:
    g = gate(least_determined=12)
    decision = g.judge(consistent(), calibration(determined=11))
    assert (decision.action, decision.in_force, decision.status) == ("take", False, "COLLECTING")
    assert decision.reason == "not in force yet, parameters not determined: Qz"
    still = replace(consistent(), still="the motion is in a plane")
    assert g.judge(still, calibration(determined=11)).reason == f"{decision.reason}; the motion is in a plane"
    assert (decision.numbers["determined"], decision.numbers["determined_threshold"]) == (11, 12)
    assert g.judge(consistent(), calibration()).status == "VALID"
    assert g.judge(consistent(), calibration(determined=4)).in_force  # what is in force once stays


def test_what_settles_is_what_was_in_force() -> None:
    g = gate(least_determined=12)
    assert held(calibration(determined=4), g).status == "COLLECTING"
    assert g.judge(consistent(), calibration()).status == "VALID"


def test_the_limit_of_consistency_is_the_stated_quantile() -> None:
    """2 %: Wilson and Hilferty's formula is 1.3 % high so far out, at 9 degrees of freedom."""
    for statistic, action in ((0.99 * LIMIT_AT_1E_4, "take"), (1.03 * LIMIT_AT_1E_4, "hold")):
        decision = valid().judge(Evidence(0.0, statistic, DOF), NEAR)
        assert decision.action == action
        assert decision.numbers["innovation_chi2"] == statistic
        assert decision.numbers["innovation_chi2_threshold"] == pytest.approx(LIMIT_AT_1E_4, rel=0.02)


def test_nan_is_not_consistent() -> None:
    assert valid().judge(Evidence(0.0, float("nan"), DOF), NEAR).action == "hold"
    assert valid().judge(consistent(), calibration(NOMINAL * np.nan)).action == "hold"


def test_what_is_no_number_is_not_proposed() -> None:
    decision = valid().judge(consistent(), calibration(NOMINAL * np.nan))
    assert (decision.action, decision.propose) == ("hold", False)
    assert "the estimate gives no number for Sxx" in decision.reason
    assert valid().judge(consistent(), scaled(1.06)).propose


@pytest.mark.parametrize(
    ("places", "reason"),
    [
        (np.diag([0.001, 1.0, 1.0]), "output x is dead"),
        (np.eye(3)[[1, 0, 2]], "det S is negative"),
        (np.eye(3)[[1, 2, 0]], "axes are exchanged"),
    ],
)
def test_a_dead_output_and_exchanged_axes_are_not_proposed(places: np.ndarray, reason: str) -> None:
    decision = valid().judge(consistent(), calibration(places @ NOMINAL))
    assert (decision.action, decision.propose) == ("hold", False)
    assert reason in decision.reason


def _without(*parameters: int) -> Calibration:
    """A calibration whose data determine all but these parameters."""
    found = calibration()
    return replace(found, determined=~np.isin(np.arange(12), parameters))


def _wide(u: float) -> Calibration:
    """A calibration with this standard uncertainty of Sxy; the largest main sensitivity is 2.1."""
    found = calibration()
    covariance = found.covariance.copy()
    covariance[1, 1] = u**2
    return replace(found, covariance=covariance)


@pytest.mark.parametrize(
    ("candidate", "reason"),
    [
        (_without(0, 4, 8), "not in force yet: no main sensitivity (Sxx, Syy, Szz) is determined"),
        (_wide(1.1), "not in force yet: U(Sxy) is 2.2, above the largest main sensitivity, 2.1;"),
    ],
)
@pytest.mark.parametrize("policy", ["auto", "propose"])
def test_a_first_calibration_needs_a_main_sensitivity_and_u_below_it(
    candidate: Calibration, reason: str, policy: Literal["auto", "propose"]
) -> None:
    g = Gate(GateSettings(least_determined=4, policy=policy), calibration(u_pct=20.0))  # a data sheet
    decision = g.judge(consistent(), candidate)
    assert (decision.action, decision.in_force, decision.propose) == ("take", False, False)
    assert decision.reason.startswith(reason)
    assert decision.status == "COLLECTING"
    after = g.judge(consistent(), _without(0, 4))
    assert (after.in_force, after.propose) == (policy == "auto", policy == "propose")


@pytest.mark.parametrize("policy", ["auto", "propose"])
def test_a_first_calibration_needs_two_windows_or_ten_seconds(policy: str) -> None:
    g = gate(policy=policy)
    decision = g.judge(replace(consistent(), enough=False), NEAR)
    assert (decision.action, decision.in_force, decision.propose) == ("take", False, False)
    assert decision.reason.startswith("not in force yet: two windows, or 10 s, are needed")
    after = g.judge(consistent(), NEAR)
    assert (after.in_force, after.propose) == (policy == "auto", policy == "propose")
    assert valid().judge(replace(consistent(), enough=False), NEAR).in_force  # what is in force once stays


# --- how far


@pytest.mark.parametrize(
    ("candidate", "named"),
    [
        (changed(1, 1, 0.0949), ""),
        (changed(1, 1, 0.0951), "Syy"),
        (changed(1, 1, -0.0951), "Syy"),
        (changed(0, 2, 0.0599), ""),
        (changed(0, 2, -0.0601), "Sxz"),
        (scaled(1.06), "Sxx, Syy, Szz"),
        (scaled(-1.0), "Sxx, Syy, Szz"),
        (calibration(NOMINAL[[1, 0, 2]]), "Sxx, Syy, Sxy, Syx"),
        (turned(1.6), ""),
        (turned(1.9), "Sxy, Syx"),
        (calibration(offset=300.0), ""),
    ],
)
def test_max_change_at_its_defaults(candidate: Calibration, named: str) -> None:
    """5 % of the main sensitivity, 3 % of 2.0 across, no limit for the offset."""
    reason = Anchor(SETTINGS, calibration()).change(candidate).reason
    assert reason.startswith(f"S or Q changed by more than max_change: {named}" if named else "")
    assert bool(reason) == bool(named)


@pytest.mark.parametrize(("angle_deg", "beyond"), [(2.9, False), (3.1, True), (-3.1, True)])
def test_a_common_rotation_has_its_own_limit(angle_deg: float, beyond: bool) -> None:
    change = Anchor(GateSettings(max_change_transverse_pct=20.0), calibration()).change(turned(angle_deg))
    assert change.numbers["rotation_deg"] == pytest.approx(abs(angle_deg), abs=1e-9)
    assert change.numbers["rotation_deg_threshold"] == 3.0
    assert change.reason == ("S or Q changed by more than max_change: common rotation" if beyond else "")


def test_a_rotation_is_that_of_the_polar_decomposition() -> None:
    """S S0^-1 = R P with a symmetric P of our own; a reflection is half a turn."""
    stretch = np.array([[1.1, 0.05, 0.0], [0.05, 0.9, 0.02], [0.0, 0.02, 1.0]])
    S = turned(2.0).sensitivity @ np.linalg.inv(NOMINAL) @ stretch @ NOMINAL
    assert np.degrees(rotation_rad(S, NOMINAL)) == pytest.approx(2.0, abs=1e-9)
    assert rotation_rad(-NOMINAL, NOMINAL) == pytest.approx(np.pi)


def test_offsets_are_limited_where_it_is_configured() -> None:
    anchor = Anchor(GateSettings(max_change_offset=0.2, largest_offset=0.45), calibration(offset=0.3))
    assert anchor.change(calibration(offset=0.44)).reason == ""
    assert "Qx (beyond largest_offset)" in anchor.change(calibration(offset=0.46)).reason
    low = anchor.change(calibration(offset=0.09))
    assert low.reason == "S or Q changed by more than max_change: Qx, Qy, Qz"
    assert (low.numbers["change_offset"], low.numbers["change_offset_threshold"]) == pytest.approx((0.21, 0.2))


def test_many_small_steps_do_not_walk_away() -> None:
    g, steps = valid(), [scaled(1 + 0.0011 * k) for k in range(1, 80)]
    decisions = [g.judge(consistent(), step) for step in steps]
    assert [d.action for d in decisions] == ["take"] * 45 + ["hold"] * 34
    assert all(d.in_force for d in decisions[:45])
    assert not any(d.in_force for d in decisions[45:])
    last = decisions[-1]
    assert (last.status, last.propose) == ("HELD", True)
    assert re.search(r"more than max_change: Sxx, Syy, Szz; held until an operator accepts", last.reason)


def test_a_data_sheet_limits_at_its_uncertainty_until_the_data_know_better() -> None:
    """u 6 %: within 12 % at first; then 5 % about what was found, once that is known to 2.5 %, and only once."""
    g = Gate(SETTINGS, calibration(u_pct=6.0))
    assert g.judge(consistent(), calibration(NOMINAL * 1.10, u_pct=4.0)).action == "take"
    assert g.judge(consistent(), calibration(NOMINAL * 1.13, u_pct=4.0)).action == "hold"
    assert g.judge(consistent(), calibration(NOMINAL * 1.10, u_pct=0.5)).action == "take"  # anchored here
    assert g.judge(consistent(), scaled(1.14)).action == "take"
    assert g.judge(consistent(), scaled(1.10 * 1.051)).action == "hold"
    assert g.judge(consistent(), scaled(1.10 * 0.949)).action == "hold"


def test_a_later_run_goes_on_counting_from_the_same_anchor() -> None:
    first = Gate(SETTINGS, calibration(u_pct=6.0))
    first.judge(consistent(), scaled(1.10))
    first.judge(consistent(), scaled(1.14))
    later = Gate(SETTINGS, first.accepted, scaled(1.14))
    assert later.status == "VALID"
    assert later.judge(consistent(), scaled(1.10 * 1.049)).action == "take"
    assert later.judge(consistent(), scaled(1.10 * 1.051)).action == "hold"
    with pytest.raises(
        ValueError, match="was in force before cannot be used: S or Q changed by more than max_change: Sxx"
    ):
        Gate(SETTINGS, first.accepted, scaled(1.2))


@pytest.mark.parametrize("bad", [np.zeros((3, 3)), np.full((3, 3), np.nan), NOMINAL[[1, 0, 2]] * (1 - np.eye(3))])
def test_nothing_starts_from_a_sensitivity_without_an_inverse(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="S and Q must be finite, S must have an inverse"):
        Gate(SETTINGS, calibration(bad))


# --- jumps


def test_a_jump_is_held_and_dismissed_when_it_does_not_last() -> None:
    g = valid()
    first = g.judge(jumped(), FAR)
    assert (first.action, first.status, first.held, first.in_force) == ("hold", "HELD", 1, False)
    assert first.reason.startswith("the window contradicts the calibration")
    after = [g.judge(consistent(), NEAR) for _ in range(3)]
    assert [d.status for d in after] == ["HELD", "HELD", "VALID"]
    assert [d.held for d in after] == [1, 1, 0]
    assert {d.action for d in after} == {"take"}


def test_a_jump_between_consistent_windows_is_not_dismissed_by_few() -> None:
    g = valid()
    evidence = [jumped(), consistent(), consistent()] * 5
    decisions = [g.judge(e, NEAR if e.statistic < 100 else FAR, NEAR) for e in evidence]
    assert [d.action for d in decisions].count("adopt") == 1
    assert decisions[12].action == "adopt"  # the fifth jump


def test_a_confirmed_jump_within_max_change_is_adopted_and_settles() -> None:
    g = valid()
    decision = held(scaled(1.04), g)
    assert (decision.action, decision.in_force, decision.held) == ("adopt", True, 0)
    assert decision.status == "RECALIBRATING"
    assert decision.reason == "a jump was confirmed by 5 windows that agree with each other"
    settling = [g.judge(consistent(), scaled(1.04)).status for _ in range(6)]
    assert settling == ["RECALIBRATING"] * 4 + ["VALID"] * 2


def test_a_jump_is_not_adopted_before_enough_windows_agree() -> None:
    g = valid()
    early = [g.judge(jumped(), FAR, NEAR) for _ in range(4)]
    assert {d.action for d in early} == {"hold"}
    assert g.judge(jumped(), FAR, None).action == "hold"  # five, which do not agree
    assert g.judge(jumped(), FAR, NEAR).action == "adopt"


def test_a_confirmed_jump_beyond_max_change_waits_for_an_operator() -> None:
    g = valid()
    decision = held(FAR, g, 9)
    assert (decision.action, decision.status, decision.propose, decision.in_force) == ("hold", "HELD", True, False)
    assert decision.numbers["change_main_pct"] == pytest.approx(6.0)
    g.published(71)
    answer = g.accept(71, "key-1")
    assert answer.calibration is FAR
    assert (answer.status, answer.reason, answer.refused) == ("VALID", "estimate 71 accepted by key-1", "")
    assert "can be: none" in g.accept(71, "key-1").refused
    # It is the new anchor: 5 % about it.
    assert g.judge(consistent(), scaled(1.06 * 1.049)).action == "take"
    assert g.judge(consistent(), scaled(1.0)).action == "hold"


def test_no_more_windows_are_kept_aside_than_confirm_a_jump() -> None:
    """Months of HELD cost no more than a day; and a wild window falls out of those that must agree."""
    g = valid()
    kept = [g.judge(jumped(), FAR).held for _ in range(50)]
    assert kept == [1, 2, 3, 4] + [5] * 46
    assert g.held == 5
    assert g.judge(jumped(), FAR, NEAR).action == "adopt"
    assert g.held == 0


def test_what_is_proposed_is_told() -> None:
    assert valid().judge(consistent(), FAR).proposal is FAR
    assert held(scaled(1.07), valid()).proposal is not None
    assert valid().judge(consistent(), NEAR).proposal is None
    shadow = valid(policy="propose")
    held(FAR, shadow)
    assert shadow.judge(consistent(), NEAR, FAR).proposal is NEAR


def test_two_confirmed_jumps_do_not_walk_past_max_change() -> None:
    g = valid()
    assert held(scaled(1.04), g).action == "adopt"
    second = held(scaled(1.08), g)
    assert (second.action, second.propose, second.in_force) == ("hold", True, False)
