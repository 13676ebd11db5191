"""The line that says what to do next: in each status, for each kind of mount, and only when it changes."""

from __future__ import annotations

import io
from typing import Any

import msgspec
import pytest

from agent.config import Config, parse_config
from agent.core.events import IN_DRIVER, Command, DeviceChange, Estimate, Result, Tick
from agent.terminal.next_step import NextSteps
from agent.terminal.state import ViewState
from agent.terminal.view import LineView
from tests.unit.results import calibration, status, window
from tests.unit.test_view import picture

CLAMP = [{"theta_deg": 35, "alpha_deg": alpha} for alpha in (0, 120, 240)]
TIMED = [{**stop, "start_s": 15.0 * k, "stop_s": 15.0 * k + 12.0} for k, stop in enumerate(CLAMP)]
FACES = [{"gravity_mps2": [sign * 9.81 * (i == k) for k in range(3)]} for i in range(3) for sign in (1, -1)]
PUBLIC = "dzWPEyU0pMzL6HqvwwMvtIvoksq07njf+E/rdjfIIgM="
CLOCK: dict[str, Any] = {"t_monotonic_ns": 0, "t_utc_ns": 0}
FIRST = "turn the sensor to theta 35 deg, alpha 0 deg and stay 20 s (positions used: 0 of 3)"


def configured(commands: bool = False, *, reference: bool = True, **channel: Any) -> Config:
    devices = [{"name": "mems", "driver": "virtual", "options": {"role": "sensor"}}]
    if reference:
        devices.append({"name": "laser", "driver": "virtual", "options": {"role": "reference"}})
        channel["reference"] = "laser"
    raw: dict[str, Any] = {"devices": devices, "channels": [{"sensor": "mems", "prior": {}, **channel}]}
    if commands:
        key = {"id": "anna", "public_key": PUBLIC, "verbs": ["accept", "hold"], "sensors": ["mems"]}
        raw["commands"] = {"enabled": True, "keys": [key]}
    return parse_config(raw, "test")


def said(guide: NextSteps, *results: Result, event: Any = None) -> str:
    return guide.update(event or Tick(**CLOCK), list(results)).get("mems", "")


def used(position: str, sequence: int = 1) -> Result:
    return msgspec.structs.replace(window(sequence), position=position)


def refused(reason: str) -> list[Result]:
    return [window(1, used=False, reason=reason)] * 3


def command(verb: str, arguments: str = "{}", refused: str = "") -> Command:
    return Command(sensor="mems", verb=verb, arguments_json=arguments, refused=refused, **CLOCK)  # type: ignore[arg-type]


def test_nothing_is_said_before_a_sensor_has_a_status() -> None:
    assert said(NextSteps(configured(positions=CLAMP), turns_itself=False)) == ""


def test_each_position_that_is_left_is_named_in_turn() -> None:
    guide = NextSteps(configured(positions=CLAMP), turns_itself=False)
    assert said(guide, status(1, "UNCALIBRATED")) == FIRST
    told = said(guide, used("theta 35 deg, alpha 0 deg"), status(2, "COLLECTING"))
    assert told == "turn the sensor to theta 35 deg, alpha 120 deg and stay 20 s (positions used: 1 of 3)"
    assert said(guide, used("theta 35 deg, alpha 0 deg")) == told, "the same position once more"
    assert "alpha 240" in said(guide, used("theta 35 deg, alpha 120 deg"))
    told = said(guide, used("theta 35 deg, alpha 240 deg"), calibration(3), status(4))
    assert told == "nothing has to be done; more positions make U smaller. `fieldcal certificate` makes the certificate"


def test_a_position_with_times_is_told_with_them() -> None:
    guide = NextSteps(configured(poses=TIMED), turns_itself=False)
    told = said(guide, status(1, "UNCALIBRATED"))
    assert told == (
        "turn the sensor to theta 35 deg, alpha 0 deg; the configuration states that position from 0 to 12 s after "
        "the first sample"
    )
    first = msgspec.structs.replace(used("theta 35 deg, alpha 0 deg"), start_s=0.5, stop_s=11.5)
    assert "alpha 120 deg; the configuration states that position from 15 to 27 s" in said(guide, first)
    last = msgspec.structs.replace(window(9, used=False), start_s=30.5, stop_s=42.0)
    assert said(guide, last) == "state further positions: those of the configuration are over"


def test_positions_that_repeat_have_no_end() -> None:
    guide = NextSteps(configured(poses=TIMED, poses_repeat_s=50.0), turns_itself=False)
    late = msgspec.structs.replace(window(9, used=False), position="theta 35 deg, alpha 0 deg", stop_s=61.5)
    told = said(guide, status(1, "UNCALIBRATED"), late)
    assert (
        "alpha 0 deg; the configuration states that position from 0 to 12 s after the first sample, and every 50 s"
        in told
    )
    first = msgspec.structs.replace(used("theta 35 deg, alpha 0 deg"), stop_s=111.5)
    assert "alpha 120 deg" in said(guide, first)


def test_rests_are_told_by_the_axis_that_points_up() -> None:
    config = configured(reference=False, positions=FACES)
    guide = NextSteps(config, turns_itself=False)
    told = said(guide, status(1, "UNCALIBRATED"))
    assert told == "put the sensor down with its +x axis up and stay 20 s (positions used: 0 of 6)"
    assert "its -x axis up" in said(guide, used(config.channels[0].stops[0].position))


@pytest.mark.parametrize(
    ("channel", "words"),
    [
        ({"rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1]}, "wait for motion in all three directions"),
        ({"poses": TIMED[:1]}, "the configuration states one position, so nothing has to be turned"),
        ({"positions": "free"}, "turn the clamp to another alpha and stay 20 s; three are needed, 0 are used"),
        ({"positions": CLAMP, "gate": {"policy": "observe"}}, "no calibration comes into force"),
    ],
)
def test_other_mounts(channel: dict[str, Any], words: str) -> None:
    assert words in said(NextSteps(configured(**channel), turns_itself=False), status(1, "UNCALIBRATED"))


def test_a_virtual_bench_turns_by_itself() -> None:
    guide = NextSteps(configured(poses=TIMED), turns_itself=True)
    assert said(guide, status(1, "UNCALIBRATED")) == "wait: the virtual bench turns by itself; positions used: 0"
    assert said(guide, used("a"), status(1, "COLLECTING")).endswith("positions used: 1")
    assert "Ctrl-C ends the run" in said(guide, status(2))


def test_a_lost_device_is_named_until_it_is_back() -> None:
    guide = NextSteps(configured(positions=CLAMP), turns_itself=False)
    said(guide, status(1))
    for device in ("mems", "laser"):
        told = said(guide, status(2), event=DeviceChange(device=device, state="lost", **CLOCK))
        assert told.startswith(f"check power and cable of {device};")
        back = said(guide, event=DeviceChange(device=device, state="open", **CLOCK))
        assert back.startswith("nothing has to be done")
    assert "cable of mems" in said(guide, status(3, "INVALID", "no block of mems for more than 5 s"))


def test_a_fault_of_a_driver_is_no_matter_of_cables() -> None:
    guide = NextSteps(configured(positions=CLAMP), turns_itself=False)
    change = DeviceChange(device="mems", state="lost", message=f"{IN_DRIVER} lab.Imu: KeyError: 'x'", **CLOCK)
    told = said(guide, status(1, "INVALID"), event=change)
    assert told == "use another version of the driver of mems, and tell its author of the fault"


@pytest.mark.parametrize(
    ("reason", "words"),
    [
        ("too few points: 10, 30 needed", "stay longer"),
        ("the reference is silent: 0.01 m/s2 rms in band, 0.02 m/s2 needed (its noise is 0.007 m/s2)", "more motion"),
        ("dead: the output of 1 of the sensor's axes does not change at all", "always indicates the same value"),
        ("clipped: 7 points at the end of the sensor's range", "a larger range"),
        ("the sensor does not follow the reference: coherence 0.400, 0.5 needed", "fasten sensor and reference"),
        ("the sensor's mean changes by 0.4 m/s2 within the window, 0.2 m/s2 at most", "hands and cables off"),
        ("9.0 % of the points are knocks, 5 % at most", "keep knocks away"),
        ("7.1 % of the samples of mems are missing, 5 % at most", "`fieldcal doctor --measure 5`"),
        ("the sensor stands at none of the stated positions: the nearest is a, with chi-squared 90, the limit is 21",
         "turn the sensor to a stated position"),
        ("a reason of a later version", "mend what the reason of the newest windows names"),
    ],
)  # fmt: skip
def test_what_helps_follows_from_the_reason(reason: str, words: str) -> None:
    for state in ("UNCALIBRATED", "COLLECTING", "VALID"):
        guide = NextSteps(configured(positions=CLAMP), turns_itself=False)
        one, *rest = refused(reason)
        assert words not in said(guide, status(1, state), one), "one window is no reason"
        assert words in said(guide, *rest)
        assert words not in said(guide, used("theta 35 deg, alpha 0 deg"))


def test_held_windows_are_not_refused() -> None:
    """After the loss of a device nothing is held any more, and one refused window is no reason for a remedy."""
    guide = NextSteps(configured(positions=CLAMP), turns_itself=False)
    held = window(1, used=False, reason="the window contradicts the calibration")
    held.numbers["innovation_chi2"] = 900.0
    one, *_ = refused("9.0 % of the points are knocks, 5 % at most")
    assert "knocks" not in said(guide, status(1), held, held, one)
    assert "knocks" in said(guide, one, one)


def test_held_and_what_ends_it() -> None:
    guide = NextSteps(configured(commands=True, positions=CLAMP), turns_itself=False)
    told = said(guide, status(1, "HELD", "the window contradicts the calibration"))
    assert "5 windows that agree confirm a change, 3 that fit the calibration end HELD" in told
    told = said(guide, estimate(7))
    assert "`fieldcal command accept --sensor mems --sequence 7`" in told
    assert said(guide, calibration(8), status(9)).startswith("nothing has to be done")
    assert said(guide, status(9, "RECALIBRATING")).startswith("leave everything as it is")


def test_an_estimate_cannot_be_accepted_where_commands_are_off() -> None:
    channels: tuple[dict[str, Any], ...] = ({}, {"gate": {"policy": "propose"}})
    for channel in channels:
        guide = NextSteps(configured(positions=CLAMP, **channel), turns_itself=False)
        told = said(guide, estimate(7), status(8, "COLLECTING" if channel else "HELD"))
        assert "enable [commands] in the configuration" in told


def test_a_hold_lasts_until_it_is_released() -> None:
    guide = NextSteps(configured(commands=True, positions=CLAMP), turns_itself=False)
    release = "`fieldcal command hold --release --sensor mems` lets the agent use windows again"
    assert said(guide, status(1, "HELD"), event=command("hold", refused="no right")) != release
    assert said(guide, status(1, "HELD"), event=command("hold")) == release
    assert said(guide, status(2), event=command("hold", '{"release": true}')).startswith("nothing")
    assert said(guide, event=command("rollback")).startswith("nothing"), "the calibration was another device's"
    assert said(guide, calibration(3), event=command("rollback")) == release
    begun = msgspec.structs.replace(status(1, "HELD", "restored from the previous run"), before="")
    assert said(NextSteps(configured(positions=CLAMP), turns_itself=False), begun) == release


def estimate(sequence: int) -> Estimate:
    common = {"run_id": "r", "sequence": sequence, "sensor": "mems", "t_utc_ns": 0}
    return Estimate(**common, reason="beyond max_change", calibration=calibration(sequence))  # type: ignore[arg-type]


def test_the_line_is_shown_when_it_changes_and_stays_on_the_screen() -> None:
    state, stream = ViewState("gateway.toml", "site/gateway"), io.StringIO()
    view = LineView(state, stream)
    for step in (FIRST, FIRST, "nothing has to be done", FIRST):
        state.take([status(1)])
        state.next_steps["mems"] = step
        view.refresh()
    lines = [line for line in stream.getvalue().splitlines() if ": next: " in line]
    assert lines == [f"mems: next: {step}" for step in (FIRST, "nothing has to be done", FIRST)]
    shown = [line.strip() for line in picture(state, 60, 24)]
    assert " ".join(shown[3:5]) == f"next: {FIRST}", "on a narrow terminal it has two lines, and no word is lost"


def test_without_a_reference_and_positions_the_configuration_is_named() -> None:
    """The agent ended with an internal fault when it looked for the next of no positions."""
    guide = NextSteps(configured(reference=False), turns_itself=False)
    assert said(guide, status(1, "UNCALIBRATED")).startswith("calibrate it at a bench or by a visit")
