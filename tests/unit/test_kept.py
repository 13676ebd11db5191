"""What a later run makes of a state that was made with another geometry."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from agent.config import Channel, parse_config
from agent.core.driver_filters import DriverFilters
from agent.core.estimation import Estimation
from agent.core.kept import KeptEstimation, keep, take_up
from agent.core.outcome import ResultSource, calibration_update
from agent.core.snapshot import pack, unpack

G = 9.80665
UP = {"direction": [1.0, 0.0, 0.0], "gravity_mps2": [0.0, 0.0, G]}
UPSIDE_DOWN = {"direction": [1.0, 0.0, 0.0], "gravity_mps2": [0.0, 0.0, -G]}
SIDEWAYS = {"direction": [0.0, 1.0, 0.0], "gravity_mps2": [0.0, 0.0, G]}
RESTORED = "restored from the previous run"
EXCHANGED = "these settings have changed and were exchanged in the state"


def channel(*stances: dict[str, Any], **more: Any) -> Channel:
    """A sensor that stands 10 s each in these poses."""
    devices = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": 50}} for n in ("s", "r", "other")]
    poses = [{"start_s": 10 * k, "stop_s": 10 * k + 10, **stance} for k, stance in enumerate(stances)]
    held = {"sensor": "s", "reference": "r", "prior": {"sensitivity": 1.0}, "poses": poses}
    return parse_config({"devices": devices, "channels": [held | more]}, "").channels[0]


def state_of(made_with: Channel) -> bytes:
    """A state with a calibration in force."""
    estimation = Estimation(made_with, None)
    state = estimation.state
    in_force = calibration_update(
        ResultSource("s", "A", "m/s2", 5), estimation.in_force, state, state.shares(), lambda _: None
    )
    return keep(DriverFilters(made_with), "", estimation, in_force, None, 0.0, 5)


def after(before: Channel, now: Channel) -> KeptEstimation:
    return take_up(state_of(before), DriverFilters(now), None)


@pytest.mark.parametrize(
    ("before", "now", "named"),
    [
        (channel(UP), channel(UPSIDE_DOWN), "poses"),  # the position's name tells the direction alone
        (channel(UP), channel(SIDEWAYS), "poses"),
        (channel(UP, SIDEWAYS), channel(UPSIDE_DOWN, SIDEWAYS), "poses"),
        (
            channel(positions="free", clamp_theta_deg=30.0),
            channel(positions="free", clamp_theta_deg=40.0),
            "clamp_theta_deg",
        ),
        (channel(positions=[UP, UPSIDE_DOWN | {"direction": [0, 0, 1]}]), channel(positions="free"), "positions"),
    ],
)
def test_a_state_made_at_another_mount_keeps_s_and_its_references_and_loosens_the_angles(
    before: Channel, now: Channel, named: str
) -> None:
    found = after(before, now)
    assert found.reason == f"{RESTORED}; {EXCHANGED}: {named}"
    assert found.in_force is not None
    assert found.estimation.state.windows == 0


@pytest.mark.parametrize(
    ("before", "now"),
    [
        (channel(UP, SIDEWAYS), channel(SIDEWAYS, UP)),  # at other times
        (channel(UP, SIDEWAYS), channel(UP, SIDEWAYS, {"direction": [0.0, 0.0, 1.0], "gravity_mps2": [0, 0, G]})),
        (channel(positions="free", clamp_theta_deg=30.0), channel(positions="free", clamp_theta_deg=30.0)),
    ],
)
def test_what_stands_as_before_is_the_same_mount(before: Channel, now: Channel) -> None:
    assert after(before, now).reason == RESTORED


def test_a_state_of_an_earlier_version_says_nothing_of_its_mount() -> None:
    state = unpack(state_of(channel(UP)))
    for name in ("poses", "positions", "clamp_theta_deg"):
        del state["basis"][name]
    assert take_up(pack(state), DriverFilters(channel(UP)), None).reason == RESTORED


def test_a_field_that_the_earlier_version_did_not_have_counts_with_its_default() -> None:
    def of_earlier(section: str, field: str) -> bytes:
        state = unpack(state_of(channel(UP)))
        fields = msgspec.json.decode(state["basis"][section])
        del fields[field]
        state["basis"][section] = msgspec.json.encode(fields).decode()
        return pack(state)

    for section, field in (("prior", "u_offset_mps2"), ("certificate", "u_lag_s"), ("uncertainty", "lag_s")):
        assert take_up(of_earlier(section, field), DriverFilters(channel(UP)), None).reason == RESTORED
    stated = channel(UP, certificate={"u_lag_s": 1e-3})
    assert take_up(of_earlier("certificate", "u_lag_s"), DriverFilters(stated), None).reason.endswith(
        "in the state: certificate"
    )


def test_of_version_8_the_calibration_in_force_is_left() -> None:
    """Its records hold less than those of today; gate, devices and all beside the estimation go on."""
    made_with = channel(UP, UPSIDE_DOWN)
    state = unpack(state_of(made_with))
    packed = msgspec.msgpack.decode(state_of(made_with)) | {"version": 8}
    written = unpack(msgspec.msgpack.encode(packed))
    assert written["estimation"].keys() == {"state", "day", "gate", "in_force"}
    assert written["filters"] == state["filters"]
    later = Estimation(made_with, None)
    later.load(written["estimation"])
    np.testing.assert_array_equal(later.in_force.sensitivity, state["estimation"]["in_force"]["sensitivity"])
    assert later.state.windows == 0
