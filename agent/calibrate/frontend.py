"""From files to windows: clocks out of the stamps, the reference at the sensor's sample times, verdicts."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.calibrate.poses import PoseInterval
from agent.calibrate.tables import ReferenceTable, SensorTable, TableError
from calib.excitation.alignment import Drift, drift
from calib.excitation.window_verdict import DEFAULT_LIMITS, Limits
from calib.excitation.windows import Points, judged, motion_parts, rest_sd, rest_window
from calib.model import Array, Pose, Window, WindowSums
from calib.signal.band import lowpass, lowpass_lost, moving_band_hz
from calib.signal.resampling import HALF, NODES, differentiate, resample
from calib.signal.stamps import clock_from_stamps
from calib.signal.timing import ClockFit

GUARD_S = 0.1  # left out at both ends of a pose: hands, and what the clocks do not know
LEVEL_STRETCH_S = 3600.0  # of reference looked at in one go for where it moves; bounds memory


@dataclass(frozen=True, slots=True)
class Options:
    """How windows are made. Method 3 as printed: `leave_out` False keeps every point, `align` False takes both files'
    clocks as they are."""

    leave_out: bool = True
    align: bool = True
    guard_s: float = GUARD_S
    limits: Limits = DEFAULT_LIMITS


class FrontEnd:
    """Windows of a sensor's file, a reference's file and the poses; can be made again with another lag.

    Raises TableError where files do not overlap in time.
    """

    def __init__(
        self,
        sensor: SensorTable,
        reference: ReferenceTable | None,
        poses: Sequence[PoseInterval],
        options: Options | None = None,
    ) -> None:
        self._sensor = sensor
        self._reference = reference
        self._options = options or Options()
        self.sensor_clock = clock_from_stamps(sensor.time_s)
        self.reference_clock = None if reference is None else clock_from_stamps(reference.time_s)
        self.drift: Drift | None = None  # of the sensor's clock against the reference's, once windows were made
        self.band_hz: float | None = None  # to which both signals are limited, once `limit_band` found one
        self.poses = poses
        self._check_overlap()

    def windows(self, lag_s: float = 0.0, progress: Callable[[float], Any] | None = None) -> list[Window]:
        """All windows in order of the poses, used or not. The sensor's indications are taken to lag by `lag_s`.

        Where their clocks run apart, that is found the first time and taken out. `progress` is called with the seconds
        of recording just done.
        """
        found = self._made(lag_s, progress)
        if self._options.align and self.drift is None:
            self.drift = drift(found)
            if self._runs_apart is not None:
                found = self._made(lag_s, progress)
        return found

    @property
    def _runs_apart(self) -> Drift | None:
        return self.drift if self.drift is not None and self.drift.significant else None

    def _made(self, lag_s: float, progress: Callable[[float], Any] | None) -> list[Window]:
        floor = self._rest_floor()
        windows: list[Window] = []
        for interval in self.poses:
            start_s, stop_s = interval.start_s + self._options.guard_s, interval.stop_s - self._options.guard_s
            if interval.pose.direction.shape[1]:
                found = list(self._motion(interval.pose, start_s, stop_s, lag_s))
            else:
                found = self._rest(interval.pose, start_s, stop_s, floor)
            windows += found or [_empty(interval, "no samples of sensor and reference in this pose")]
            if progress is not None:
                progress(interval.stop_s - interval.start_s)
        return windows

    def runs(self) -> Iterator[tuple[Points, Window]]:
        """Windows in motion with all their samples, for methods that need more than sums."""
        for interval in self.poses:
            if interval.pose.direction.shape[1]:
                start_s, stop_s = interval.start_s + self._options.guard_s, interval.stop_s - self._options.guard_s
                for points, windows in self._judged(interval.pose, start_s, stop_s, lag_s=0.0):
                    for window in windows:
                        first = int(np.searchsorted(points.time_s, window.start_s, side="left"))
                        stop = int(np.searchsorted(points.time_s, window.stop_s, side="right"))
                        yield points.part(first, stop), window

    def _motion(self, pose: Pose, start_s: float, stop_s: float, lag_s: float) -> Iterator[Window]:
        for _, windows in self._judged(pose, start_s, stop_s, lag_s):
            yield from windows

    def _judged(self, pose: Pose, start_s: float, stop_s: float, lag_s: float) -> Iterator[tuple[Points, list[Window]]]:
        """Samples of each part of a pose, and their windows."""
        assert self.reference_clock is not None
        limits, leave_out = self._options.limits, self._options.leave_out
        for kind, part_start_s, part_stop_s in self._parts(start_s, stop_s):
            pieces = max(1, math.ceil((part_stop_s - part_start_s) / limits.longest_s))
            edges = np.linspace(part_start_s, part_stop_s, pieces + 1)
            for a, b in itertools.pairwise(edges.tolist()):
                points = self.points(a, b, lag_s)
                if len(points.time_s) > 1:
                    yield points, judged(kind, pose, points, limits, leave_out=leave_out)

    def _parts(self, start_s: float, stop_s: float) -> Iterator[tuple[Any, float, float]]:
        """(kind, start, stop) of where the reference moves and where it is calm."""
        assert self._reference is not None
        assert self.reference_clock is not None
        clock, x = self.reference_clock, self._reference.x
        for begin_s in np.arange(start_s, stop_s, LEVEL_STRETCH_S):
            first, stop = _rows(clock, len(x), float(begin_s), min(float(begin_s) + LEVEL_STRETCH_S, stop_s))
            if stop - first < 2:
                continue
            for kind, a, b in motion_parts(np.asarray(x[first:stop]), clock.rate_hz):
                edges = clock.time_of([first + a, first + b - 1])
                yield kind, float(edges[0]), float(edges[1])

    def points(self, start_s: float, stop_s: float, lag_s: float = 0.0) -> Points:
        """Samples of the sensor from `start_s` to `stop_s`; with a reference those that have one, when they felt it."""
        first, stop = _rows(self.sensor_clock, len(self._sensor.time_s), start_s, stop_s)
        time_s = self.sensor_clock.time_of(np.arange(first, stop))
        if self._reference is None or self.reference_clock is None:
            nothing = np.empty((len(time_s), 0))
            return Points(time_s, np.asarray(self._sensor.v[first:stop]), nothing, nothing)
        if self.band_hz is not None:
            around = lowpass_lost(self.sensor_clock.rate_hz, self.band_hz)
            first, stop = max(0, first - around), min(len(self._sensor.time_s), stop + around)
            time_s = self.sensor_clock.time_of(np.arange(first, stop))
        felt_s = time_s - lag_s
        if (apart := self._runs_apart) is not None:
            felt_s -= apart.rate * (time_s - apart.time_s)
        m = self._reference.x.shape[1]
        if not len(time_s):
            return Points(time_s, np.empty((0, 3)), np.empty((0, m)), np.empty((0, m)))
        x, x_first, margin = self._reference_part(float(felt_s[0]), float(felt_s[-1]))
        out = resample(x, self.reference_clock, felt_s, x_first, margin)
        V = np.asarray(self._sensor.v[first:stop])
        if self.band_hz is None:
            return Points(time_s[out.usable], V[out.usable], out.u[out.usable], out.du[out.usable])
        columns = np.where(out.usable[:, None], np.hstack([V, out.u, out.du]), np.nan)
        columns = lowpass(columns, self.sensor_clock.rate_hz, self.band_hz)
        kept = np.isfinite(columns).all(axis=1) & (time_s >= start_s) & (time_s <= stop_s)
        return Points(time_s[kept], columns[kept, :3], columns[kept, 3 : 3 + m], columns[kept, 3 + m :])

    def limit_band(self, loud: Sequence[Window], quiet: Sequence[Window]) -> bool:
        """Limit both signals to the band in which the reference moves, as these windows show; whether that is less."""
        found = moving_band_hz(
            [self.points(w.start_s, w.stop_s).u for w in loud],
            [self.points(w.start_s, w.stop_s).u for w in quiet],
            self.sensor_clock.rate_hz,
        )
        self.band_hz = found
        return found is not None

    def _reference_part(self, start_s: float, stop_s: float) -> tuple[Array, int, int]:
        """Acceleration around a stretch of time, the number of its first sample, and how many at its ends are wrong."""
        assert self._reference is not None
        assert self.reference_clock is not None
        clock, x = self.reference_clock, self._reference.x
        lost = differentiate(np.zeros((1, 1)), clock.rate_hz)[1] if self._reference.velocity else 0
        around = lost + HALF + NODES
        low, high = clock.index_of([start_s, stop_s])
        first, stop = max(0, math.floor(low) - around), max(0, min(len(x), math.ceil(high) + around))
        part = np.asarray(x[first:stop])
        if self._reference.velocity and len(part) > 2 * lost:
            part, _ = differentiate(part, clock.rate_hz)
        return part, first, lost

    def _rest(self, pose: Pose, start_s: float, stop_s: float, floor: Array | None) -> list[Window]:
        first, stop = _rows(self.sensor_clock, len(self._sensor.time_s), start_s, stop_s)
        if stop - first < 2:
            return []
        time_s = self.sensor_clock.time_of(np.arange(first, stop))
        V = np.asarray(self._sensor.v[first:stop])
        options = self._options
        return [rest_window(pose, time_s, V, options.limits, floor=floor, leave_out=options.leave_out)]

    def _rest_floor(self) -> Array | None:
        """The sensor's usual noise at rest, over all static poses."""
        found = []
        for interval in self.poses:
            if interval.pose.direction.shape[1] == 0:
                first, stop = _rows(self.sensor_clock, len(self._sensor.time_s), interval.start_s, interval.stop_s)
                sd = rest_sd(np.asarray(self._sensor.v[first:stop]), self.sensor_clock.rate_hz)
                if sd is not None:
                    found.append(sd)
        return np.asarray(np.median(found, axis=0)) if found else None

    def _check_overlap(self) -> None:
        sensor = self._sensor
        times = (float(sensor.time_s[0]), float(sensor.time_s[-1]))
        spans = [(f"{sensor.path}", *times)]
        if self._reference is not None:
            other = self._reference
            spans.append((f"{other.path}", float(other.time_s[0]), float(other.time_s[-1])))
        if self.poses:
            spans.append(("the poses", min(p.start_s for p in self.poses), max(p.stop_s for p in self.poses)))
        if max(s for _, s, _ in spans) >= min(e for _, _, e in spans):
            told = ", ".join(f"{name} from {start:.10g} s to {stop:.10g} s" for name, start, stop in spans)
            raise TableError(f"no overlap in time: {told}")


def _rows(clock: ClockFit, n: int, start_s: float, stop_s: float) -> tuple[int, int]:
    """[first, stop) of the samples taken between two times."""
    low, high = clock.index_of([start_s, stop_s])
    first = min(max(math.ceil(low), 0), n)
    return first, min(max(math.floor(high) + 1, first), n)


def _empty(interval: PoseInterval, reason: str) -> Window:
    m = interval.pose.direction.shape[1]
    q = 2 * m + 3
    sums = WindowSums(m, np.empty(0), np.empty((0, q)), np.empty((0, q, q)))
    kind = "motion" if m else "rest"
    return Window(interval.start_s, interval.stop_s, interval.pose, sums, False, reason, 0, 0, kind)  # type: ignore[arg-type]


def windows_from_tables(
    sensor: SensorTable,
    reference: ReferenceTable | None,
    poses: Sequence[PoseInterval],
    options: Options | None = None,
    lag_s: float = 0.0,
) -> list[Window]:
    """The windows of files, once; see FrontEnd."""
    return FrontEnd(sensor, reference, poses, options).windows(lag_s)
