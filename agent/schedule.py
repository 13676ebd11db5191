"""When the sensor stands how: the poses of the configuration, repeated for ever if it says so."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

from agent.config import Channel, PoseInterval
from calib.geometry import clamp_pose, direction_pose, rest_pose
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
    period_s = channel.poses_repeat_s
    if not channel.poses:
        return
    for cycle in itertools.count(int(after_s // period_s)) if period_s else (0,):
        base_s = cycle * period_s if period_s else 0.0
        for i, interval in enumerate(channel.poses):
            start_s = max(after_s, base_s + interval.start_s + channel.guard_s)
            stop_s = base_s + interval.stop_s - channel.guard_s
            for part in range(math.ceil((stop_s - start_s) / WINDOW_S)):
                first_s = start_s + part * WINDOW_S
                yield Piece(first_s, min(stop_s, first_s + WINDOW_S), interval_pose(interval, channel, str(i + 1)))


def interval_pose(interval: PoseInterval, channel: Channel, position: str) -> Pose:
    """The pose as the estimator takes it."""
    raise NotImplementedError
