"""The poses of the sensor over time, from the configuration or by command; with poses_repeat_s they repeat for ever."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from agent.config import Channel, PoseInterval
from agent.config.knowledge import Nine
from calib.excitation.pieces import pieces_of
from calib.geometry import beside
from calib.model import Pose


@dataclass(frozen=True, slots=True)
class PosePiece:
    """An interval of time in one pose, without the guards at its ends; seconds since the sensor's first sample."""

    start_s: float
    stop_s: float
    pose: Pose


@dataclass(frozen=True, slots=True)
class Stance:
    """The pose of the sensor between two times, guards included; the last stance has no end."""

    start_s: float
    stop_s: float
    pose: Pose

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        pose = {name: getattr(self.pose, name) for name in Pose.__slots__}
        return {"start_s": self.start_s, "stop_s": self.stop_s, "pose": pose}

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> Stance:
        """The stance whose `snapshot` this is."""
        return cls(state["start_s"], state["stop_s"], Pose(**state["pose"]))


class ToldTimes:
    """Gives the pieces in order of time; their times come from the configuration or from commands.

    Seconds as in Piece.
    """

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._after_s = 0.0  # pieces up to this time are done
        self._stances: list[Stance] = []  # by command; empty while the poses of the configuration apply
        self._plan()

    def _plan(self) -> None:
        self._upcoming = pieces(self._channel, self._after_s, self._stances)
        self.piece = next(self._upcoming, None)

    def done(self, piece: PosePiece) -> None:
        """This piece is done; the next one becomes `piece`."""
        self._after_s = piece.stop_s
        self.piece = next(self._upcoming, None)

    def pass_over(self, time_s: float) -> None:
        """Leave out all pieces that begin before `time_s`."""
        self._after_s = max(self._after_s, time_s)
        self._plan()

    @property
    def keep_from_s(self) -> float:
        """Samples before this time are not needed any more."""
        return math.inf if self.piece is None else self.piece.start_s

    def turn(self, now_s: float, pose: Pose) -> None:
        """An operator states a new pose, which begins now."""
        stood = []
        if self.piece is not None and self.piece.start_s < now_s:
            # The previous pose ends now, and its window with it, a guard earlier as at every change. If its piece has
            # ended already and only waits for late samples, its end stays as it is.
            stop_s = min(now_s, self.piece.stop_s + self._channel.guard_s)
            stood = [Stance(self.piece.start_s - self._channel.guard_s, stop_s, self.piece.pose)]
        self._stances = [*stood, Stance(now_s, math.inf, pose)]
        self._plan()

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {"after_s": self._after_s, "stances": [stance.snapshot() for stance in self._stances]}

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._after_s, self._stances = state["after_s"], [Stance.load(s) for s in state["stances"]]
        self._plan()


def pieces(channel: Channel, after_s: float, stances: Sequence[Stance] = ()) -> Iterator[PosePiece]:
    """The pieces after `after_s`, in order of time; without end if the schedule repeats.

    If there are `stances`, they replace the poses of the configuration.
    """
    stretches = ((s.start_s, s.stop_s, s.pose) for s in stances) if stances else _stretches(channel, after_s)
    for start_s, stop_s, pose in stretches:
        cut = pieces_of(start_s, stop_s, channel.window_s, channel.guard_s, channel.every_s, after_s)
        yield from (PosePiece(first_s, last_s, pose) for first_s, last_s in cut)


def _stretches(channel: Channel, after_s: float) -> Iterator[tuple[float, float, Pose]]:
    if channel.rotation is not None:
        yield 0.0, math.inf, pose_beside(channel.rotation, channel)
        return
    period_s = channel.poses_repeat_s
    for cycle in itertools.count(int(after_s // period_s)) if period_s and channel.poses else (0,):
        base_s = cycle * period_s if period_s else 0.0
        for interval in channel.poses:
            yield base_s + interval.start_s, base_s + interval.stop_s, pose_of(interval, channel)


def pose_beside(rotation: Nine, channel: Channel) -> Pose:
    """The pose beside a tri-axial reference with this rotation."""
    return beside([rotation[i : i + 3] for i in (0, 3, 6)], channel.rotation_gravity_mps2)


def pose_of(interval: PoseInterval, channel: Channel) -> Pose:
    """The pose that a section of the configuration or a command states."""
    return interval.pose(channel.gravity_mps2, channel.static_sign, feels_gravity=channel.coupling == "dc")
