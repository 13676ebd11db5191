"""The samples of a channel: which pieces of them are due, the windows in a piece, and a verdict on each window."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.config import Channel
from agent.core.estimation import DAY_S, Estimation, Judged
from agent.core.positions import FOUND_WITHIN_S, FoundPositions
from agent.core.quiet_hours import QuietHours
from agent.core.raw_watch import RawWatch
from agent.core.schedule import PosePiece, ToldTimes, pose_beside
from agent.core.stream import DeviceStream
from agent.core.time_shift import Anew
from agent.core.windows import StretchWindows, aligned_in, limits_of, margin_of, refused, windows_in
from calib.excitation.front_end import most_margin_s
from calib.excitation.lag_search import without_lag
from calib.excitation.placing import Placed
from calib.model import Array, Pose, Window
from calib.signal.response import FLAT, UNSETTLED, Response
from calib.signal.timing import HORIZON_S
from hw.block import LARGEST, SampleBlock

LEAST_PART_S = 1.0  # between two restarts of a device; less makes no window
FOUND_EDGE_S = 1.0  # from a hole to the end of the stretch that it ends, where gravity tells the stretches


@dataclass(frozen=True, slots=True, eq=False)
class JudgedWindow:
    """A window and what the estimation made of it; None where it was not asked, for the reason in the window.

    `lag_s` was taken out of the sensor's times.
    """

    window: Window
    judged: Judged | None
    lag_s: float


RESPONSE_TURNS = 6  # the first windows begin with no response
MOST_DUE = 100  # pieces between two events; a tick comes each second, a window has 1 s, and samples are 60 s late


def completed(window: Window, missing: Mapping[str, float]) -> Window:
    """The window with what is missing in its numbers."""
    return replace(window, numbers={**window.numbers, **missing}) if missing else window


class Streams:
    """The newest samples of a sensor and of its reference, and when the sensor stood how.

    `by_device` are the streams by the name of the device. Times are seconds since the run's origin.
    """

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._beside = channel.by_reference
        self._limits = [limits_of(beside) for beside in self._beside]
        self._number = 0  # of the piece that is due next
        self.by_device: dict[str, DeviceStream] = {}
        self._finder = FoundPositions(channel) if channel.positions else None
        self._places = self._finder or ToldTimes(channel)
        self._runs: dict[str, int] = {}  # of each device, the number of the run of which the last part was
        self._raw = RawWatch(self._horizon_s)
        self._quiet = QuietHours()
        self._margin_at: tuple[list[float | None], float] = [], 0.0  # margin in s, and the rates of which it follows

    def begin(self, origin_ns: int) -> None:
        """A new run, nothing is there yet."""
        names = [self._channel.sensor, *(beside.reference for beside in self._beside)]
        self.by_device = {name: DeviceStream(name, origin_ns, self._horizon_s) for name in names if name}

    def state(self, channel: Channel) -> None:
        """Other filters are known of the devices from now on: their windows need more samples around them, or fewer."""
        self._channel, self._beside, self._margin_at = channel, channel.by_reference, ([], 0.0)
        for stream in self.by_device.values():
            stream.look_back(self._horizon_s)

    @property
    def place(self) -> int:
        """The place of the reference of the piece that is due next.

        Each piece has one reference, so that no sample of the sensor counts twice. The references take turns in the
        order of Thue and Morse, A B B A B A A B and so on: in a round of positions that repeats, each position meets
        both, and none has more than two pieces in a row.
        """
        return self._number.bit_count() % len(self._beside)

    @property
    def _in_use(self) -> dict[str, DeviceStream]:
        """The streams of the sensor and of the reference of the piece that is due next."""
        beside = self._beside[self.place]
        return {name: self.by_device[name] for name in (beside.sensor, beside.reference) if name}

    def look_where(self, block: SampleBlock, estimation: Estimation) -> None:
        """Where nobody told how the sensor stands, gravity in its newest block may."""
        if self._finder is not None:
            self._finder.update(block, self._sensor, estimation.state.scale)

    def watch(self, block: SampleBlock, scale: float, origin_utc_ns: int) -> list[str]:
        """Take note of a block that `by_device` has taken: what is wrong with its samples, for an operator.

        `scale`: the sensor's sensitivity, in output unit per m/s2, as far as known.
        """
        expected = np.zeros(block.indications.shape[1])
        if block.device == self._channel.sensor:
            expected = self._expected(scale, len(expected))
        return self._raw.update(block, self.by_device[block.device], expected, origin_utc_ns)

    def suspect(self, device: str) -> NDArray[np.bool_]:
        """(A,) the outputs of which samples are wrong in the block that `watch` took last."""
        return self._raw.suspect(device)

    def _expected(self, scale: float, axes: int) -> Array:
        """(A,) rms of the newest motion along each axis of the sensor by its reference, in output unit."""
        beside, piece = self._beside[0], self._places.piece
        found = None if beside.reference is None else self._raw.motion(beside.reference)
        if found is None or piece is None or beside.instrument.derivatives or axes != 3:
            return np.zeros(axes)
        direction = piece.pose.direction
        if direction.shape[1] != len(found):
            return np.zeros(axes)
        power = np.einsum("im,mn,in->i", direction, found, direction)
        return np.asarray(scale / beside.instrument.sensitivity * np.sqrt(np.maximum(power, 0.0)))

    def forget(self, device: str) -> None:
        """Another device has this name now: samples of the one before are nothing to it."""
        self.by_device[device].clear()
        self._raw.forget(device)
        self._quiet.forget(device)

    def forget_sensor(self) -> None:
        """Another device takes the sensor's place: samples of the one before are nothing to it."""
        self.forget(self._channel.sensor)
        if self._finder is not None:
            self._finder.forget()

    def turn(self, now_s: float, pose: Pose) -> None:
        """An operator says how the sensor stands from now on."""
        first_s = self._sensor.first_sample_s
        self._places.turn(0.0 if first_s is None else now_s - first_s, pose)

    def due(self, now_s: float) -> Iterator[PosePiece]:
        """The pieces whose samples are all there, or later than anybody waits for; what is old is then forgotten.

        Between two events pass a few pieces at most. If more than MOST_DUE are due, the time has jumped: those that end
        before the samples that are kept are left out, whatever their number is.
        """
        first_s = self._sensor.first_sample_s
        made, margin_s = 0, self._margin_s
        while (piece := self._places.piece) is not None and first_s is not None:
            if not self._due(first_s + piece.stop_s + margin_s, now_s):
                break
            made += 1
            if made == MOST_DUE:
                self._places.pass_over(now_s - first_s - self._channel.late_horizon_s - 2.0 * self._horizon_s)
                continue
            yield piece
            self._places.done(piece)
            self._number += 1
        around_s = 2.0 * margin_s
        keep_from_s = now_s - around_s
        if first_s is not None:
            keep_from_s = min(keep_from_s, first_s + self._places.keep_from_s - around_s)
        for stream in self.by_device.values():
            stream.forget_before(keep_from_s)

    def verdicts(
        self, piece: PosePiece, first_day: float, estimation: Estimation | None, unusable: str
    ) -> Iterator[JudgedWindow]:
        """A verdict on each window of a piece. `first_day` is the run's origin in the estimation's own count.

        `unusable` says why the reference may not be used, "" where it may. The parts of the piece between which a
        device began to count anew have windows of their own; what is missing is told in their numbers.
        """
        first_s = self._sensor.first_sample_s
        assert first_s is not None  # a piece was due
        missing = self._missing(piece, first_s)
        beside = self._beside[self.place]
        if self.place:
            missing["check_reference"] = 1.0
        if self.place and beside.rotation is not None:
            piece = replace(piece, pose=pose_beside(beside.rotation, beside))
        for part in self._parts(piece, first_s):
            for verdict in self._of_part(part, first_s, first_day, estimation, unusable):
                yield replace(verdict, window=completed(verdict.window, missing))

    def _parts(self, piece: PosePiece, first_s: float) -> list[PosePiece]:
        """What lies between the breaks of both devices; the whole piece where no part of it is long enough."""
        start_s, stop_s = first_s + piece.start_s, first_s + piece.stop_s
        breaks = [found for stream in self._in_use.values() for found in stream.breaks(start_s, stop_s)]
        if not breaks:
            return [piece]
        parts, at_s = [], start_s
        for ended_s, began_s in [*sorted(breaks), (stop_s, stop_s)]:
            if ended_s - at_s >= LEAST_PART_S:
                parts.append(replace(piece, start_s=at_s - first_s, stop_s=ended_s - first_s))
            at_s = max(at_s, began_s)
        return parts or [piece]

    def _missing(self, piece: PosePiece, first_s: float) -> dict[str, float]:
        """Numbers for the windows of a piece that holes cut, or end where a position was found by gravity."""
        beyond_s = self._channel.guard_s + FOUND_EDGE_S if self._finder else 0.0
        start_s, stop_s = first_s + piece.start_s - beyond_s, first_s + piece.stop_s + beyond_s
        numbers = {}
        for name, stream in self._in_use.items():
            of = "" if name == self._channel.sensor else "reference_"
            numbers[f"{of}missing_samples"] = stream.missing(start_s, stop_s)
            numbers[f"{of}restarts"] = len(stream.breaks(start_s, stop_s))
            numbers[f"{of}late_samples"] = stream.late(start_s, stop_s)
        return {name: float(count) for name, count in numbers.items() if count}

    def _of_part(
        self, piece: PosePiece, first_s: float, first_day: float, estimation: Estimation | None, unusable: str
    ) -> Iterator[JudgedWindow]:
        day = first_day + (first_s + piece.stop_s) / DAY_S
        placed, lag_s, anew = Placed(piece.pose, "", {}), 0.0, None
        span_s = first_s + piece.start_s, first_s + piece.stop_s
        if unsound := self._unsound(*span_s) or self._raw.reason(self._in_use, *span_s):
            found = StretchWindows([refused(piece, unsound)])
        else:
            self._look_for_restarts(first_s + piece.start_s, first_s + piece.stop_s, estimation)
            placed = self._placed(piece, first_s, day, estimation)
            if placed.pose is None or unusable:
                found = StretchWindows([refused(piece, unusable or placed.reason)])
            else:
                self._listen(span_s, day)
                found, lag_s, anew = self._windows(replace(piece, pose=placed.pose), first_s, day, estimation)
        found = found.with_numbers(placed.numbers)
        for window in found.windows:
            judged = None
            if window.used and estimation is not None:
                judged = estimation.judge(window, day, lag_s, found.temperature_degc, anew, self.place)
                anew = None  # the first window has set the lag in the state
            yield JudgedWindow(window, judged, lag_s)

    def _listen(self, span_s: tuple[float, float], day: float) -> None:
        """Take note of how noisy the reference is at most, by its samples of a part."""
        beside = self._beside[self.place]
        cut = None if beside.reference is None else self.by_device[beside.reference].cut(*span_s)
        if cut is not None and cut.in_time:
            values = cut.values / beside.instrument.sensitivity
            self._quiet.update(cut.device, day, values, cut.clock.rate_hz)

    def _look_for_restarts(self, start_s: float, stop_s: float, estimation: Estimation | None) -> None:
        """A device that began to count anew since the last part may be late by another time."""
        for name, stream in self._in_use.items():
            number = stream.run_number(start_s, stop_s)
            if number is not None and number != self._runs.get(name):
                self._runs[name] = number
                if estimation is not None:
                    estimation.began(name)

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            "streams": {name: stream.snapshot() for name, stream in self.by_device.items()},
            "places": self._places.snapshot(),
            "run_numbers": dict(self._runs),
            "raw": self._raw.snapshot(),
            "quiet": self._quiet.snapshot(),
            "piece_number": self._number,
        }

    def load(self, origin_ns: int, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self.by_device = {
            n: DeviceStream.restore(n, origin_ns, s, self._horizon_s) for n, s in state["streams"].items()
        }
        self._places.load(state["places"])
        self._runs, self._number = dict(state["run_numbers"]), state["piece_number"]
        self._raw.load(state["raw"])
        self._quiet.load(state.get("quiet", {}))  # not in states of engine 22 and before

    @property
    def _sensor(self) -> DeviceStream:
        return self.by_device[self._channel.sensor]

    @property
    def _horizon_s(self) -> float:
        around_s = 2.0 * max(most_margin_s(beside.instrument) for beside in self._beside)
        return max(HORIZON_S, self._channel.window_s + around_s + (FOUND_WITHIN_S if self._finder else 0.0))

    @property
    def _margin_s(self) -> float:
        rates_hz = [stream.nominal_rate_hz for stream in self.by_device.values()]
        if rates_hz != self._margin_at[0]:
            self._margin_at = rates_hz, max(margin_of(beside, self.by_device) for beside in self._beside)
        return self._margin_at[1]

    def _due(self, end_s: float, now_s: float) -> bool:
        return now_s > end_s + self._channel.late_horizon_s or all(s.reaches(end_s) for s in self._in_use.values())

    def _unsound(self, start_s: float, stop_s: float) -> str:
        """Which device shows a number that nothing can be computed from, and which; "" where none does."""
        for name, stream in self._in_use.items():
            cut = None if stream.sound else stream.cut(start_s - self._margin_s, stop_s + self._margin_s)
            if cut is None:
                continue
            shown = {
                "an indication": cut.values.ravel(),
                "its temperature in degC": np.array([cut.temperature_degc]),
            }
            for what, values in shown.items():
                beyond = values[np.abs(values) > LARGEST]  # NaN is a sample that is missing
                if len(beyond):
                    return f"{name}: {what} is {beyond[0]:.6g}, too large to compute with ({LARGEST:g} at most)"
        return ""

    def _placed(self, piece: PosePiece, first_s: float, day: float, estimation: Estimation | None) -> Placed:
        """How the sensor stands in the piece, where nobody told."""
        if self._finder is None or estimation is None:
            return Placed(piece.pose, "", {})
        cut = self._sensor.cut(first_s + piece.start_s, first_s + piece.stop_s)
        return self._finder.place(piece, cut, estimation.state, day)

    def _windows(
        self, piece: PosePiece, first_s: float, day: float, estimation: Estimation | None
    ) -> tuple[StretchWindows, float, Anew | None]:
        """The windows, made again until neither a lag nor a response is left in them that matters; what a search for
        another lag found."""
        if estimation is None or self._channel.reference is None:
            lag_s = 0.0 if estimation is None else estimation.state.lag_s(self.place)
            return self._make(piece, first_s, FLAT, np.inf, lag_s), lag_s, None
        trial, place = estimation.state, self.place
        lag_s, response, known = trial.lag_s(place), trial.response(place), trial.response_is_known(place)

        def lag_of(found: StretchWindows, lag_s: float) -> float:
            nonlocal trial
            # What contradicts a known state must not move the common lag: that would be an answer to another question.
            if not (known and estimation.contradicted(found, day, lag_s, place)):
                trial = estimation.after(found.used, day, lag_s, found.temperature_degc, place)
            return estimation.own_lag_s(found, day, lag_s, place, trial)

        for _ in range(RESPONSE_TURNS):
            make = partial(self._make, piece, first_s, response, estimation.state.motion_to_hz)
            found, lag_s = without_lag(lag_s, make, lambda found: found.used, lag_of)
            if known or not found.used or trial.response_is(response, place):
                break
            response = trial.response(place).modest
        else:
            return found.refused(UNSETTLED), lag_s, None
        if estimation.contradicted(found, day, lag_s, place):
            return self._explained(piece, first_s, day, estimation, found, lag_s, response)
        return found, lag_s, None

    def _explained(
        self,
        piece: PosePiece,
        first_s: float,
        day: float,
        estimation: Estimation,
        found: StretchWindows,
        lag_s: float,
        response: Response,
    ) -> tuple[StretchWindows, float, Anew | None]:
        """As `_found`, of windows that contradict: those of the part whose samples have the known lag, where others
        have not; else those at another lag, if one explains them; else what was found."""
        state, watch, to_hz = estimation.state, estimation.lag_watch(self.place), estimation.state.motion_to_hz
        samples = aligned_in(piece, first_s, self._beside[self.place], self.by_device, lag_s, response, to_hz)
        if samples is None:
            return found, lag_s, None
        if (part_s := watch.part_in_time(state, piece.pose, samples, lag_s)) is not None:
            part = replace(piece, start_s=part_s[0] - first_s, stop_s=part_s[1] - first_s)
            within = self._make(part, first_s, response, to_hz, lag_s)
            if within.used and not estimation.contradicted(within, day, lag_s, self.place):
                time_s = samples.points.time_s
                count = np.count_nonzero((time_s < part_s[0]) | (time_s > part_s[1]))
                return within.with_numbers({"misplaced_samples": float(count)}), lag_s, None
        make = partial(self._make, piece, first_s, response, to_hz)
        anew = watch.search(state, make, found, lag_s, piece.pose, samples, day)
        if anew is not None and not anew.beyond:
            return anew.found, anew.lag_s, anew
        return found.because(watch.beyond), lag_s, None

    def _make(self, piece: PosePiece, first_s: float, response: Response, to_hz: float, lag_s: float) -> StretchWindows:
        beside, limits = self._beside[self.place], self._limits[self.place]
        most_noise = self._quiet.most_noise(beside.reference or "")
        return windows_in(piece, first_s, beside, self.by_device, lag_s, response, to_hz, limits, most_noise)
