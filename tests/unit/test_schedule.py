"""When the sensor stands how, by configuration and by command."""

from __future__ import annotations

import pytest

from agent.config import parse_config
from agent.config.channel import Channel
from agent.core.schedule import ToldTimes
from calib.geometry import clamp
from calib.model import Pose


def channel() -> Channel:
    devices = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": 50.0}} for n in "sr"]
    held = {
        "sensor": "s", "reference": "r", "prior": {"sensitivity": 1.0}, "guard_s": 0.5, "window_s": 60.0,
        "poses": [
            {"start_s": 0, "stop_s": 20, "theta_deg": 35, "alpha_deg": 0},
            {"start_s": 20, "stop_s": 900, "theta_deg": 35, "alpha_deg": 30},
        ],
    }  # fmt: skip
    return parse_config({"devices": devices, "channels": [held]}, "").channels[0]


def pose(alpha_rad: float) -> Pose:
    return clamp(0.6, alpha_rad, 9.8, 1)


def test_a_pose_by_command_closes_the_window_of_the_one_before() -> None:
    times = ToldTimes(channel())
    times.turn(12.0, pose(1.0))
    assert times.piece is not None
    assert (times.piece.start_s, times.piece.stop_s) == pytest.approx((0.5, 11.5))
    times.done(times.piece)
    assert (times.piece.start_s, times.piece.stop_s) == pytest.approx((12.5, 72.5))
    assert times.piece.pose.alpha_rad == 1.0


def test_a_pose_that_ended_is_not_drawn_out_while_its_window_waits() -> None:
    times = ToldTimes(channel())
    times.turn(23.0, pose(1.0))  # the window up to 19.5 s waits for late samples; from 20 s on it stood otherwise
    assert times.piece is not None
    assert (times.piece.start_s, times.piece.stop_s) == pytest.approx((0.5, 19.5))


def test_a_pose_that_is_put_right_at_once_leaves_the_one_before_as_it_was() -> None:
    times = ToldTimes(channel())
    times.turn(12.0, pose(1.0))
    times.turn(14.0, pose(2.0))  # the operator had mistyped the first
    assert times.piece is not None
    assert (times.piece.start_s, times.piece.stop_s) == pytest.approx((0.5, 11.5))
    times.done(times.piece)
    assert times.piece.start_s == pytest.approx(14.5)
    assert times.piece.pose.alpha_rad == 2.0


def test_a_schedule_goes_on_from_its_snapshot() -> None:
    times, other = ToldTimes(channel()), ToldTimes(channel())
    times.turn(12.0, pose(1.0))
    times.turn(14.0, pose(2.0))
    other.load(times.snapshot())
    for _ in range(5):
        assert times.piece is not None
        assert other.piece is not None
        assert (other.piece.start_s, other.piece.stop_s) == (times.piece.start_s, times.piece.stop_s)
        times.done(times.piece)
        other.done(other.piece)
