"""When the sensor stands how: the poses of the configuration, repeated for ever if it says so."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from agent.config import Channel, PoseInterval
from calib.geometry import along, at_rest, beside, clamp
from calib.model import Pose

ROUNDING_S = 1e-6  # of ends that were added up


@dataclass(frozen=True, slots=True)
class Piece:
    """One stretch of time in one pose, guards taken off; seconds since the sensor's first sample."""

    start_s: float
    stop_s: float
    pose: Pose


@dataclass(frozen=True, slots=True)
class Stance:
    """How the sensor stands between two times, guards not yet taken off; the last one has no end."""

    start_s: float
    stop_s: float
    pose: Pose

    def snapshot(self) -> dict[str, Any]:
        """State for `load`."""
        pose = {name: getattr(self.pose, name) for name in Pose.__slots__}
        return {"start_s": self.start_s, "stop_s": self.stop_s, "pose": pose}

    @staticmethod
    def load(state: Mapping[str, Any]) -> Stance:
        """The stance whose `snapshot` this is."""
        return Stance(state["start_s"], state["stop_s"], Pose(**state["pose"]))


def pieces(channel: Channel, after_s: float, stances: Sequence[Stance] = ()) -> Iterator[Piece]:
    """The pieces that lie after `after_s`, in order of time; without end where the schedule repeats.

    `stances`, where there are any, take the place of the configuration's poses.
    """
    stretches = ((s.start_s, s.stop_s, s.pose) for s in stances) if stances else _stretches(channel, after_s)
    for start_s, stop_s, pose in stretches:
        last_s, k = start_s + channel.guard_s, 0
        if not math.isfinite(stop_s):
            k = max(0, int((after_s - last_s) // (channel.every_s or channel.window_s)))
        while last_s < stop_s - channel.guard_s:
            first_s = start_s + channel.guard_s + k * (channel.every_s or channel.window_s)
            last_s, k = min(first_s + channel.window_s, stop_s - channel.guard_s), k + 1
            if first_s > after_s - ROUNDING_S and first_s < last_s:
                yield Piece(first_s, last_s, pose)


def _stretches(channel: Channel, after_s: float) -> Iterator[tuple[float, float, Pose]]:
    if channel.rotation is not None:
        rows = [channel.rotation[i : i + 3] for i in (0, 3, 6)]
        yield 0.0, math.inf, beside(rows, channel.rotation_gravity_mps2)
        return
    period_s = channel.poses_repeat_s
    for cycle in itertools.count(int(after_s // period_s)) if period_s and channel.poses else (0,):
        base_s = cycle * period_s if period_s else 0.0
        for interval in channel.poses:
            yield base_s + interval.start_s, base_s + interval.stop_s, pose_of(interval, channel)


def pose_of(interval: PoseInterval, channel: Channel) -> Pose:
    """The pose that a section of the configuration, or a command, states."""
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
