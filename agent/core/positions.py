"""Where the sensor stands, found from its own output: when it was turned, and how it stands in between."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from agent.config import Channel
from agent.core.schedule import PosePiece, Stance, pieces
from agent.core.stream import UNCOUNTED, DeviceStream
from calib.excitation.placing import Placed, PlacingUncertainty, clamp_angles, mean_output, nearest_stop
from calib.excitation.standing import KEPT, MEAN_S, Standing
from calib.excitation.window_verdict import Limits
from calib.model import Array, Pose
from calib.signal.samples import Samples
from calib.state.state import State
from hw.block import SampleBlock

FOUND_WITHIN_S = KEPT * MEAN_S  # of samples that may still turn out to belong to a stretch
# A garbled line may say 1e20; beside it every departure would look small. No motion that gravity is seen in is larger.
LARGEST_MPS2 = 200.0
TURN_S = 2.0  # a shorter time between two stretches is too short to turn the sensor to another position and back
LEAST_SHARE = 0.5  # of a short mean's samples; with fewer nobody knows what happened meanwhile
NONE_BEFORE = (-math.inf, np.zeros(3))  # end of the newest stretch that ended, and its mean output
NONE_STOOD = (0, "", False)  # the newest stretch that was placed: serial, position, whether the sensor slipped
# How it stands in a stretch before `place` has looked.
OPEN = Pose("unknown", np.zeros((3, 0)), np.full(3, np.nan))


@dataclass(slots=True)
class PositionStretch:
    """Between two changes of position; the newest one has no end yet.

    `serial` counts them. `smoothing_s` is how long the sensor's output must be averaged, because of slow motion.
    `moved_mps2`: the difference of its mean output from that with which the stretch before began; 0 where more than
    TURN_S lie between them.
    """

    serial: int
    start_s: float
    stop_s: float
    smoothing_s: float
    moved_mps2: float = 0.0


class FoundPositions:
    """The pieces of the stretches in which the sensor stood. Seconds since the sensor's first sample.

    `update` takes the sensor's blocks; `piece` is the next one that no later block can change.
    """

    def __init__(self, channel: Channel) -> None:
        self._channel, self._stops = channel, channel.stops
        self._standing = Standing()
        self._stretches: list[PositionStretch] = []
        self._told: list[Stance] = []  # by operators, each until the next change
        self._angles: dict[int, Pose] = {}  # by serial: what is found first holds as long as nothing changes
        self._serial = 0
        self._before, self._stood = NONE_BEFORE, NONE_STOOD
        self._after_s = 0.0
        self._expected: int | None = None  # index of the next sample
        self._origin = (0, 0)  # index of a sample and number of the mean that begins with it
        self._sum, self._count, self._passed = np.zeros(3), 0, 0  # of the mean that is being made
        self._cleared_s = self._oldest_s = 0.0

    # --- pieces

    @property
    def piece(self) -> PosePiece | None:
        """The next piece; None while it may still change."""
        found = self._next()
        if found is None or (math.isinf(self._stretch_at(found.start_s).stop_s) and found.stop_s > self._cleared_s):
            return None
        return found

    def done(self, piece: PosePiece) -> None:
        """This piece is done."""
        self._after_s = piece.stop_s
        guard_s = self._channel.guard_s
        self._stretches = [s for s in self._stretches if s.stop_s - guard_s > self._after_s]
        self._told = [t for t in self._told if t.stop_s - guard_s > self._after_s]
        serials = [s.serial for s in self._stretches]
        self._angles = {serial: pose for serial, pose in self._angles.items() if serial in serials}

    def pass_over(self, time_s: float) -> None:
        """Leave out all pieces that begin before `time_s`."""
        self.done(PosePiece(time_s, max(self._after_s, time_s), OPEN))

    @property
    def keep_from_s(self) -> float:
        """Samples before this time are not needed any more."""
        found = self._next()
        return self._oldest_s if found is None else min(found.start_s, self._oldest_s)

    def turn(self, now_s: float, pose: Pose) -> None:
        """An operator says how it stands from now on; so it does until it is turned."""
        self._told = [*self._ended(now_s), Stance(now_s, math.inf, pose)]

    def _ended(self, at_s: float) -> Iterator[Stance]:
        for told in self._told:
            if told.start_s < at_s:
                yield Stance(told.start_s, min(told.stop_s, at_s), told.pose)

    def _next(self) -> PosePiece | None:
        stances = [stance for stretch in self._stretches for stance in self._stances(stretch)]
        return next(pieces(self._channel, self._after_s, stances), None) if stances else None

    def _stances(self, stretch: PositionStretch) -> Iterator[Stance]:
        at_s = stretch.start_s
        for told in self._told:
            start_s, stop_s = max(told.start_s, at_s), min(told.stop_s, stretch.stop_s)
            if start_s < stop_s:
                if at_s < start_s:
                    yield Stance(at_s, start_s, OPEN)
                yield Stance(start_s, stop_s, told.pose)
                at_s = stop_s
        if at_s < stretch.stop_s:
            yield Stance(at_s, stretch.stop_s, OPEN)

    def _stretch_at(self, time_s: float) -> PositionStretch:
        return next(s for s in self._stretches if s.start_s <= time_s < s.stop_s)

    # --- how it stands

    def place(self, piece: PosePiece, cut: Samples | None, known: State, day: float) -> Placed:
        """How the sensor stands in a piece, by the mean of its samples `cut` and what is known of it on that day."""
        if piece.pose is not OPEN:
            return Placed(piece.pose, "", {})
        usable = cut is not None and cut.axes == 3 and cut.in_time
        stretch = self._stretch_at(piece.start_s)
        shortest_s = stretch.smoothing_s
        mean = mean_output(cut.values, cut.clock.rate_hz, shortest_s) if cut is not None and usable else None
        if cut is None or mean is None:
            return Placed(None, f"less than {shortest_s:g} s of samples, which is too short to find the position", {})
        knowledge, calibration = self._knowledge(known.scale), known.law(day).at(cut.temperature_degc)
        if self._stops:
            return self._unless_slipped(stretch, nearest_stop(mean, self._stops, calibration, knowledge))
        serial = stretch.serial
        if serial in self._angles:
            return Placed(self._angles[serial], "", {})
        theta_deg, gravity = self._channel.clamp_theta_deg, (self._channel.gravity_mps2, self._channel.static_sign)
        theta_rad = None if theta_deg is None else math.radians(theta_deg)
        placed = clamp_angles(mean, calibration, knowledge, gravity, theta_rad, f"position {serial}")
        if placed.pose is not None:
            self._angles[serial] = placed.pose
        return placed

    def _unless_slipped(self, stretch: PositionStretch, placed: Placed) -> Placed:
        """A sensor that moved, and was not turned to another position, does not stand as that position is stated."""
        if placed.pose is None:
            return placed
        u, position = self._channel.uncertainty, placed.pose.position
        most_mps2 = Limits.of(u.offset_mps2, math.radians(u.angle_deg)).most_step_mps2
        serial, stood, slipped = self._stood
        if stretch.serial != serial:
            slipped = position == stood and stretch.moved_mps2 > (0.0 if slipped else most_mps2)
            self._stood = (stretch.serial, position, slipped)
        if not slipped:
            return placed
        moved = f"the sensor slipped at {position}: its mean changed by {stretch.moved_mps2:.3g} m/s2 without a turn"
        most = f"{most_mps2:.3g} m/s2 at most by the stated uncertainties"
        return Placed(
            None, f"{moved}, {most}; turn it to a position again", placed.numbers | {"slipped_mps2": stretch.moved_mps2}
        )

    def _knowledge(self, scale: float) -> PlacingUncertainty:
        u = self._channel.uncertainty
        angle_deg = math.hypot(u.angle_deg, u.alpha_common_deg, u.theta_deg, u.theta_position_deg)
        return PlacingUncertainty(
            math.radians(angle_deg), u.gravity_mps2, scale * math.hypot(u.offset_mps2, u.offset_position_mps2)
        )

    # --- when it is turned

    def update(self, block: SampleBlock, stream: DeviceStream, scale: float) -> None:
        """Take the sensor's next block, which `stream` has already."""
        size = max(round(MEAN_S * block.nominal_rate_hz), 1)
        if block.flags & UNCOUNTED and self._expected is not None:
            # What stood until then is a stretch of its own, timed by the clock that the stream had then.
            self._end(self._standing.interrupt(), size, stream, before_restart=True)
            self._expected = None
        if block.indications.ndim != 2 or block.indications.shape[1] != 3:
            return
        missing = 0 if self._expected is None else block.first_index - self._expected
        if self._expected is None or not 0 <= missing < size:
            self._end(self._standing.interrupt(), size, stream)
            self._begin_at(block.first_index)
            missing = 0
        values = np.clip(np.asarray(block.indications, dtype=np.float64) / scale, -LARGEST_MPS2, LARGEST_MPS2)
        self._average(np.vstack([np.full((missing, 3), np.nan), values]), size, stream)
        self._expected = block.first_index + block.n
        self._cleared_s = self._time_of(self._standing.cleared, size, stream)
        self._oldest_s = self._time_of(self._standing.oldest, size, stream)

    def forget(self) -> None:
        """The stream has dropped its samples, which are of another device: there are no windows of them."""
        self._standing.interrupt()
        self._stretches, self._angles, self._expected = [], {}, None
        self._before, self._stood = NONE_BEFORE, NONE_STOOD

    def _average(self, values: Array, size: int, stream: DeviceStream) -> None:
        """Means of `size` samples, as they become whole; missing ones (NaN) have their place."""
        while len(values):
            part, values = np.split(values, [size - self._passed])
            finite = part[np.isfinite(part.sum(axis=1))]
            self._sum = self._sum + finite.sum(axis=0)
            self._count, self._passed = self._count + len(finite), self._passed + len(part)
            if self._passed >= size:
                self._take(size, stream)

    def _begin_at(self, index: int) -> None:
        self._origin, self._expected = (index, self._standing.next), index
        self._sum, self._count, self._passed = np.zeros(3), 0, 0

    def _take(self, size: int, stream: DeviceStream) -> None:
        stood = self._standing.first is not None
        if self._count < LEAST_SHARE * size:
            self._end(self._standing.interrupt(), size, stream)
            self._begin_at(self._origin[0] + (self._standing.next - self._origin[1] + 1) * size)
            return
        self._end(self._standing.update(self._sum / self._count), size, stream)
        self._sum, self._count, self._passed = np.zeros(3), 0, 0
        if not stood and self._standing.first is not None:
            self._serial += 1
            start_s = self._time_of(self._standing.first, size, stream)
            ended_s, centre = self._before
            moved_mps2 = float(np.linalg.norm(self._standing.centre - centre)) if start_s - ended_s < TURN_S else 0.0
            self._stretches.append(
                PositionStretch(self._serial, start_s, math.inf, self._standing.smoothing_s, moved_mps2)
            )

    def _end(self, number: int | None, size: int, stream: DeviceStream, *, before_restart: bool = False) -> None:
        """The stretch ends before the mean of this number, if any."""
        if number is None:
            return
        newest = self._stretches[-1]
        newest.stop_s = max(self._time_of(number, size, stream, before_restart=before_restart), newest.start_s)
        self._before = (newest.stop_s, self._standing.centre)
        if newest.stop_s - newest.start_s <= 2.0 * self._channel.guard_s:
            self._stretches.pop()
        self._told = list(self._ended(newest.stop_s)) + [t for t in self._told if t.start_s >= newest.stop_s]

    def _time_of(self, number: int, size: int, stream: DeviceStream, *, before_restart: bool = False) -> float:
        index, first = self._origin
        assert stream.first_sample_s is not None  # it has a block
        taken_s, _ = stream.taken_at(index + (number - first) * size, before_restart=before_restart)
        return taken_s - stream.first_sample_s

    # --- state

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            "standing": self._standing.snapshot(),
            "stretches": [asdict(stretch) for stretch in self._stretches],
            "told": [told.snapshot() for told in self._told],
            "angles": [[serial, _pose_state(pose)] for serial, pose in self._angles.items()],
            "serial": self._serial,
            "before": [self._before[0], self._before[1].copy()],
            "stood": list(self._stood),
            "after_s": self._after_s,
            "expected": self._expected,
            "origin": list(self._origin),
            "mean": [self._sum.copy(), self._count, self._passed],
            "edges_s": [self._cleared_s, self._oldest_s],
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._standing.load(state["standing"])
        self._stretches = [PositionStretch(**s) for s in state["stretches"]]
        self._told = [Stance.load(s) for s in state["told"]]
        self._angles = {serial: Pose(**pose) for serial, pose in state["angles"]}
        self._serial, self._after_s, self._expected = state["serial"], state["after_s"], state["expected"]
        self._origin = (state["origin"][0], state["origin"][1])
        self._sum, self._count, self._passed = np.array(state["mean"][0]), state["mean"][1], state["mean"][2]
        self._cleared_s, self._oldest_s = state["edges_s"]
        ended, stood = state.get("before"), state.get("stood")  # not in recordings of earlier versions
        if ended is not None and stood is not None:
            self._before, self._stood = (ended[0], np.array(ended[1])), (stood[0], stood[1], stood[2])


def _pose_state(pose: Pose) -> dict[str, Any]:
    return {name: getattr(pose, name) for name in Pose.__slots__}
