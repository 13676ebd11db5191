"""When the sensor stands how: the poses of the configuration, repeated for ever if it says so."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

from agent.config import Channel, PoseInterval
from calib.geometry import along, at_rest, beside, clamp
from calib.model import Pose

# A pose that holds for long is cut into windows of this length, so that memory stays bounded and news comes.
WINDOW_S = 60.0


@dataclass(frozen=True, slots=True)
class Piece:
    """One stretch of time in one pose, guards taken off; seconds since the sensor's first sample."""

    start_s: float
    stop_s: float
    pose: Pose


def pieces(channel: Channel, after_s: float) -> Iterator[Piece]:
    """The pieces that lie after `after_s`, in order of time; without end where the schedule repeats."""
    for start_s, stop_s, pose in _stretches(channel, after_s):
        first_s = max(start_s + channel.guard_s, after_s)
        while first_s < stop_s - channel.guard_s:
            last_s = min(first_s + WINDOW_S, stop_s - channel.guard_s)
            yield Piece(first_s, last_s, pose)
            first_s = last_s


def _stretches(channel: Channel, after_s: float) -> Iterator[tuple[float, float, Pose]]:
    if channel.rotation is not None:
        rows = [channel.rotation[i : i + 3] for i in (0, 3, 6)]
        yield 0.0, math.inf, beside(rows, channel.rotation_gravity_mps2)
        return
    period_s = channel.poses_repeat_s
    for cycle in itertools.count(int(after_s // period_s)) if period_s and channel.poses else (0,):
        base_s = cycle * period_s if period_s else 0.0
        for interval in channel.poses:
            yield base_s + interval.start_s, base_s + interval.stop_s, _pose(interval, channel)


def _pose(interval: PoseInterval, channel: Channel) -> Pose:
    feels_gravity = channel.coupling == "dc"
    if interval.theta_deg is not None and interval.alpha_deg is not None:
        theta_rad, alpha_rad = math.radians(interval.theta_deg), math.radians(interval.alpha_deg)
        g = channel.gravity_mps2 if feels_gravity else 0.0
        return clamp(theta_rad, alpha_rad, g, channel.static_sign)
    if interval.direction is not None:
        gravity = interval.gravity_mps2 if feels_gravity else (0.0, 0.0, 0.0)
        return along(interval.direction, gravity)
    assert interval.gravity_mps2 is not None  # the configuration allows no other form
    return at_rest(interval.gravity_mps2)
