"""Two references beside one sensor: each has its own unknowns, and two devices name the third one that made a step."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.config import Channel, parse_config
from agent.core.driver_filters import DriverFilters
from agent.core.estimation import Estimation, Judged
from agent.core.kept import keep, take_up
from agent.core.snapshot import pack, unpack
from tests.building_windows import GRAVITY, building_window
from tests.clamp_windows import S_TRUE
from tests.unit.test_check import GOOD

SYY, STEP = 4, 0.03
ALONG_Y = np.array([0.0, STEP, 0.0])
FIRST, SECOND = 0, 1
TURNS = (0, 1, 1, 0, 1, 0, 0, 1) * 4
STEPPED = {"first": {FIRST: {"reference_error": ALONG_Y}}, "second": {SECOND: {"reference_error": ALONG_Y}}}
SENSOR = {place: {"S": S_TRUE * (1 + ALONG_Y)} for place in (FIRST, SECOND)}


def configured(stability_pct: float = 0.5, *, both: bool = True, **check: Any) -> Channel:
    """The second reference is less certain than the first one."""
    certificate = {"u_sensitivity_pct": 0.1, "stability_pct": stability_pct}
    devices = [
        {"name": name, "driver": "serial-csv", "options": {"port": name, "rate_hz": 50.0, "axes": 3}} for name in "src"
    ]
    channel: dict[str, Any] = {
        "sensor": "s",
        "reference": "r",
        "check_reference": {"device": "c", "certificate": certificate | {"u_sensitivity_pct": 0.2}} | check,
        "certificate": certificate,
        "rotation": np.eye(3).ravel().tolist(),
        "rotation_gravity_mps2": GRAVITY.tolist(),
        "prior": {"sensitivity": S_TRUE.ravel().tolist(), "u_main_pct": 1.0, "u_transverse_pct": 0.5},
        "uncertainty": {"offset_mps2": 0.002},
        "temperature": {"offset_order": 0},
    }
    if not both:
        del channel["check_reference"]
    return parse_config({"devices": devices, "channels": [channel]}, "").channels[0]


def estimation(stability_pct: float = 0.5) -> Estimation:
    return met(Estimation(configured(stability_pct), None))


def met(found: Estimation) -> Estimation:
    """Both references are connected."""
    for place, identity in enumerate("AB"):
        found.meet(identity, "", 1.0, place)
    return found


def judged(
    found: Estimation,
    seed: int,
    first_day: int,
    number: int,
    more: dict[int, dict[str, Any]] | None = None,
    turns: tuple[int, ...] = TURNS,
) -> list[Judged]:
    """A window a day; `more` by place is what has changed."""
    random, results = np.random.default_rng(seed), []
    for k, place in enumerate(turns[:number]):
        window = building_window(random, level_mps2=(0.1, 0.1, 0.1), **(more or {}).get(place, {}))
        results.append(found.judge(window, float(first_day + k), 0.0, 20.0, place=place))
    return results


def actions(results: list[Judged]) -> list[str]:
    return [result.decision.action for result in results]


@cache
def twelve_days(stability_pct: float) -> bytes:
    """The state after twelve windows, in turn with both references."""
    found = estimation(stability_pct)
    assert set(actions(judged(found, 1, 0, 12))) == {"take"}
    return pack(found.snapshot())


def sound(stability_pct: float = 0.5) -> Estimation:
    found = estimation(stability_pct)
    found.load(unpack(twelve_days(stability_pct)))
    return found


def adopted(results: list[Judged]) -> str:
    """The reason of the only jump that was adopted."""
    (reason,) = [result.decision.reason for result in results if result.decision.action == "adopt"]
    return reason


@pytest.mark.slow
def test_each_reference_has_its_own_unknowns_and_priors() -> None:
    found = sound(0.0)
    for place, u in ((FIRST, 0.1), (SECOND, 0.2)):
        assert {f"lag of {'AB'[place]}", f"rotation_x of place {place}"} <= {q.key for q in found.state.quantities}
        (stated,) = [s for s in found.state.shares(place) if s.reference == "AB"[place]]
        assert stated.u_stated[stated.unknowns.index("reference_y")] == pytest.approx(u / 100)
    assert sorted(found.state.references) == ["A", "B"]
    with_first, with_both = (1 / np.sqrt(sum(1 / u**2 for u in us)) for us in ((0.1, 1.0), (0.1, 0.2, 1.0)))
    assert 0.998 * with_both < 100 * found.in_force.standard_uncertainty[SYY] / S_TRUE[1, 1] < with_first


@pytest.mark.one_case
@pytest.mark.parametrize(("which", "device", "other"), [("first", "r", "c"), ("second", "c", "r")])
def test_the_reference_that_stepped_is_named_and_s_does_not_follow(which: str, device: str, other: str) -> None:
    found, control = sound(), sound()
    judged(control, 101, 12, 12)
    before = found.in_force
    results = judged(found, 101, 12, 12, STEPPED[which])
    reason = adopted(results)
    assert f"the reference {device} has changed by y +" in reason
    assert f"windows with {other} still agree with S" in reason
    assert float(reason.split("by y ")[1].split(" %")[0]) == pytest.approx(100 * STEP, abs=0.1)
    last = actions(results).index("adopt")
    assert set(actions(results)[last + 1 :]) == {"take"}
    u = found.in_force.standard_uncertainty
    assert np.all(u[:9] < 1.03 * control.in_force.standard_uncertainty[:9])
    assert abs(found.in_force.sensitivity[1, 1] - before.sensitivity[1, 1]) < 0.5 * u[SYY]


@pytest.mark.thorough
def test_a_reference_that_is_stated_not_to_drift_is_named_too() -> None:
    results = judged(sound(0.0), 101, 12, 24, STEPPED["first"])
    assert "the reference r has changed by y +" in adopted(results)


@pytest.mark.slow
def test_if_both_see_the_step_it_is_the_sensor_and_u_does_not_grow() -> None:
    found, control = sound(), sound()
    judged(control, 102, 12, 8)
    results = judged(found, 102, 12, 8, SENSOR)
    assert actions(results) == ["hold"] * 4 + ["adopt"] + ["take"] * 3
    assert "so the sensor has changed" in adopted(results)
    u = found.in_force.standard_uncertainty
    # Not as small as without a step: what S owes to the time when the references had drifted less is lost.
    assert np.all(u[[0, 4, 8]] < 1.25 * control.in_force.standard_uncertainty[[0, 4, 8]])
    assert abs(found.in_force.sensitivity[1, 1] - S_TRUE[1, 1] * (1 + STEP)) < 3 * u[SYY]


@pytest.mark.slow
def test_while_nobody_else_tells_u_covers_both_until_the_other_reference_does() -> None:
    found = sound()
    before = found.in_force
    alone = judged(found, 103, 12, 5, STEPPED["first"], turns=(FIRST,) * 5)
    assert "no window with c tells whether the sensor or the reference r has changed" in adopted(alone)
    assert found.in_force.standard_uncertainty[SYY] == pytest.approx(S_TRUE[1, 1] * STEP / 1.6, rel=0.1)
    judged(found, 104, 17, 8, STEPPED["first"])
    u = found.in_force.standard_uncertainty[SYY]
    assert u < 1.5 * before.standard_uncertainty[SYY]
    assert abs(found.in_force.sensitivity[1, 1] - S_TRUE[1, 1]) < 3 * u


@pytest.mark.slow
def test_a_weak_window_of_the_other_reference_is_no_witness() -> None:
    found = sound()
    assert actions(judged(found, 105, 12, 3, STEPPED["first"], turns=(FIRST,) * 3)) == ["hold"] * 3
    weak = building_window(np.random.default_rng(106), level_mps2=(0.0, 0.0, 0.1))  # nothing along y
    assert found.judge(weak, 15.0, 0.0, 20.0, place=SECOND).decision.action == "take"
    reason = adopted(judged(found, 107, 16, 2, STEPPED["first"], turns=(FIRST,) * 2))
    assert "no window with c tells" in reason


@pytest.mark.slow
def test_sound_windows_of_the_other_reference_do_not_dismiss_held_ones() -> None:
    found = sound()
    turns = (FIRST, FIRST, SECOND, SECOND, SECOND, SECOND, FIRST, FIRST, FIRST)
    results = judged(found, 112, 12, len(turns), STEPPED["first"], turns=turns)
    assert actions(results) == ["hold"] * 2 + ["take"] * 4 + ["hold"] * 2 + ["adopt"]
    assert "the reference r has changed by y +" in adopted(results)


@pytest.mark.thorough
def test_nothing_is_named_while_nothing_changes() -> None:
    assert set(actions(judged(estimation(), 108, 0, 32))) == {"take"}


@pytest.mark.slow
def test_a_state_goes_on_bit_for_bit_while_windows_are_held() -> None:
    found = sound()
    judged(found, 101, 12, 7, STEPPED["first"])
    assert found.gate.held
    again = estimation()
    again.load(found.snapshot())
    told = [judged(one, 109, 19, 3, STEPPED["first"]) for one in (found, again)]
    assert "adopt" in actions(told[0])
    assert [t.decision.reason for t in told[0]] == [t.decision.reason for t in told[1]]
    assert np.array_equal(found.in_force.covariance, again.in_force.covariance)


@pytest.mark.slow
def test_a_restarted_sensor_loosens_the_lag_behind_both_references() -> None:
    found = sound()
    before = u_lags(found)
    found.began("c")
    assert u_lags(found)[0] == pytest.approx(before[0], rel=1e-9)
    assert u_lags(found)[1] > 10 * before[1]
    found.began("s")
    assert u_lags(found)[0] > 10 * before[0]


def u_lags(found: Estimation) -> list[float]:
    return [found.state.quantity(f"lag of {identity}")[1] for identity in "AB"]


def test_a_sensor_that_was_mounted_again_has_another_rotation_to_both() -> None:
    found = sound()
    found.state.remount()
    for place in (FIRST, SECOND):
        assert found.state.quantity(f"rotation_x of place {place}")[1] >= np.deg2rad(0.2)


@pytest.mark.thorough
def test_a_second_reference_can_be_removed_and_added_again() -> None:
    found = sound()
    both, alone = configured(), configured(both=False)
    single = take_up(keep(DriverFilters(both), "", found, None, None, 12.0, 0), DriverFilters(alone), None).estimation
    single.meet("A", "", 1.0)
    assert set(actions(judged(single, 110, 12, 4, turns=(FIRST,) * 4))) == {"take"}
    again = met(
        take_up(keep(DriverFilters(alone), "", single, None, None, 16.0, 0), DriverFilters(both), None).estimation
    )
    assert set(actions(judged(again, 111, 16, 8))) == {"take"}
    value, u = again.state.quantity("reference_y of B")
    assert (abs(value), u) < (0.003, 0.002)
    assert again.in_force.standard_uncertainty[SYY] < 1.1 * found.in_force.standard_uncertainty[SYY]


def test_a_changed_rotation_of_the_second_reference_loosens_the_mount() -> None:
    before, after = np.eye(3), np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    stated = [DriverFilters(configured(rotation=rotation.ravel().tolist())) for rotation in (before, after)]
    turned = take_up(keep(stated[0], "", sound(), None, None, 12.0, 0), stated[1], None)
    assert "check_rotation" in turned.reason
    assert turned.estimation.state.quantity("rotation_x of place 1")[1] > np.deg2rad(0.2)


SECTION = (
    '[channels.check_reference]\ndevice = "laser2"\n[channels.check_reference.certificate]\nu_sensitivity_pct = 0.2\n'
)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("", "", "good; 3 devices"),
        ('device = "laser2"', 'device = "lasr2"', "check_reference.device: no device is called 'lasr2'; there is imu"),
        ('device = "laser2"', 'device = "laser"', "check_reference.device: the first reference cannot check itself"),
        ('device = "laser2"', 'device = "imu"', "check_reference.device: a sensor cannot be its own reference"),
        ("u_sensitivity_pct = 0.2", "lag_s = 0.01", "check_reference: certificate.lag_s needs certificate.u_lag_s"),
        ("u_sensitivity_pct = 0.2", "u_sensitivity = 1", "check_reference.certificate.u_sensitivity"),
        ('reference = "laser"\n', "", "check_reference is a second reference; name the first one in reference"),
        ("[channels.prior]", "[channels.gate]\ndismiss_windows = 2\n[channels.prior]", "gate.dismiss_windows 2: with"),
    ],
)
def test_the_configuration_is_checked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, told: str
) -> None:
    laser = '[[devices]]\nname = "laser2"\ndriver = "serial-csv"\noptions = { port = "b", rate_hz = 100, axes = 1 }\n'
    text = GOOD.replace("[[channels]]", f"{laser}[[channels]]").replace(
        "[channels.prior]", f"{SECTION}[channels.prior]"
    )
    path = tmp_path / "gateway.toml"
    path.write_text(text.replace(old, new, 1) if old else text)
    status = run_cli(["check", str(path)])
    shown = capsys.readouterr()
    assert told in shown.out + shown.err
    assert status == (2 if old else 0)
