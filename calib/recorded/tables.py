"""Makes windows from tables: fits clocks to the stamps, cuts the poses into pieces, and runs the front end on each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.estimate.nuisances import Priors
from calib.excitation.front_end import (
    DEFAULT_SETTINGS,
    Aligned,
    Settings,
    Unusable,
    aligned,
    margin_s,
    nothing_in,
    windows_of,
)
from calib.excitation.lag_search import BASIN_RAD, correlated_lag
from calib.excitation.pieces import pieces_of
from calib.excitation.windows import Points, motion_windows, rest_sd
from calib.model import Array, Window
from calib.recorded.alignment import drift
from calib.recorded.clock_offset import clock_offset
from calib.recorded.errors import InputError
from calib.recorded.poses import PoseInterval
from calib.recorded.segments import segments_joined, with_joined
from calib.recorded.streams import TableStream
from calib.recorded.table import FIRST_DATE_S, ReferenceTable, SensorTable, ends_s, moment
from calib.signal.band import HALVED, STOP_BAND
from calib.signal.instrument import Instrument
from calib.signal.response import FLAT, Response
from calib.signal.samples import Samples
from calib.windows.bands import HANN

HIGHEST_LIMIT = 0.4  # of the sampling rate: a limit above leaves nothing to remove
MOST_RATE = 2e-4  # by which the rates of two clocks are supposed to differ at most: quartz clocks differ by 1e-4
NEAR_RAD = 0.1  # phase of the motion: lags that are told from the windows, and their changes, are right to a per cent
GUARD_S = 0.1  # not used at both ends of a pose, because of handling and of errors of the clocks


@dataclass(frozen=True, slots=True)
class Making:
    """How windows are made from tables.

    `align` False takes the clocks of both tables as they are, as printed Method 3.
    """

    settings: Settings = DEFAULT_SETTINGS
    align: bool = True
    guard_s: float = GUARD_S


class Tables:
    """Makes windows from the sensor's table, the reference's table and the poses, as often as needed with another lag.

    `instrument` describes the reference. Raises InputError if they do not overlap in time.
    """

    def __init__(
        self,
        sensor: SensorTable,
        reference: ReferenceTable | None,
        poses: Sequence[PoseInterval],
        instrument: Instrument,
        making: Making | None = None,
    ) -> None:
        _check_overlap(sensor, reference, poses)
        self._making = making or Making()
        self._sensor = TableStream(sensor.name, sensor.time_s, sensor.v)
        self._reference = None if reference is None else TableStream(reference.name, reference.time_s, reference.x)
        self._instrument = instrument
        self.rate = 0.0  # by which the reference's times were made to run faster
        self._phase_rad = np.inf  # that the lag may still have somewhere in the windows; inf until they told it
        self.poses = poses
        first_s, end_s = self._sensor.span_s
        length_s = sum(max(min(p.stop_s, end_s) - max(p.start_s, first_s), 0.0) for p in poses)
        self._joined = segments_joined(length_s, self._making.settings.limits.segment_s)

    def beside(self, priors: Priors) -> Priors:
        """The priors; where an instrument is AC-coupled and nobody stated its corner, with those of what it does."""
        if self._reference is None or not self._instrument.corner_unknown:
            return priors
        return priors.beside_unknown_corner(self._instrument.share_of_corner)

    @property
    def rate_hz(self) -> float:
        """Rate of the sensor from its stamps."""
        return self._sensor.clock.rate_hz

    def windows(
        self,
        lag_s: float = 0.0,
        response: Response = FLAT,
        progress: Callable[[float], Any] | None = None,
        *,
        steady: bool = True,
    ) -> list[Window]:
        """All windows in the order of the poses, used or not. `lag_s` is the lag of the sensor's indications, and
        `response` their response over frequency.

        Until the lag that is left is small, each call finds whether the two clocks have different rates, and corrects
        that. `progress` is called with the seconds of recording that were just done. With `steady` False windows whose
        mean changes are used as well: a response that is not yet taken out can look like it.
        """
        settings = self._making.settings
        if not steady:
            settings = replace(settings, limits=settings.limits.unsteady)
        found = self._make(settings, lag_s, response, progress)
        if not self._making.align or self._reference is None or self._phase_rad <= NEAR_RAD:
            return found
        if (told := drift(found)) is not None:
            self._phase_rad = told.phase_rad
            if self._phase_rad <= BASIN_RAD and (told.significant if not self.rate else told.improves):
                self._stretch(told.rate, told.time_s)
                del found  # of a day, it would need as much memory once more
                return self._make(settings, lag_s, response, progress)
        return found

    @property
    def far(self) -> bool:
        """Whether the windows made last show lags that are too large to tell the lag, or the rate of a clock."""
        return BASIN_RAD < self._phase_rad < np.inf

    def likely_lag_s(self, furthest_s: float, omega: float) -> float:
        """The lag in s by cross-correlation, up to `furthest_s` to both sides; 0 without motion. `omega` is the angular
        frequency of the motion in rad/s. What the rates of the two clocks differ is corrected."""
        first_s, end_s = self._sensor.span_s
        found = correlated_lag(self._stretches(), end_s - first_s, furthest_s, MOST_RATE, omega)
        if found is None or self._reference is None:
            return 0.0
        lag_s, rate, at_s = found
        if rate:
            self._stretch(rate, at_s)
        return lag_s

    @property
    def offset_s(self) -> float:
        """By how much the reference's times were moved, because the sensor's clock shows so much more; 0 if not."""
        return 0.0 if self._reference is None else self._reference.moved_s

    def join_clocks(self, near_s: float) -> bool:
        """Move the reference's times by the offset of the two clocks, where it is more than `near_s` and was not moved
        before; whether it was. Offsets of parts of the recording that differ by `near_s` at most agree."""
        if self._reference is None or not self._making.align or self.offset_s:
            return False
        before, (first_s, end_s) = (self._reference.clock, self.rate), self._sensor.span_s
        self._reference.move(0.0)
        found = clock_offset(self._stretches(), end_s - first_s, MOST_RATE, near_s)
        if found is None or abs(found[0]) <= near_s:
            self._reference.clock, self.rate = before
            return False
        offset_s, self.rate, at_s = found
        self._reference.move(offset_s)
        self._reference.stretch(self.rate, at_s)
        self._phase_rad = np.inf
        return True

    def _stretch(self, rate: float, at_s: float) -> None:
        assert self._reference is not None
        self._reference.stretch(rate, at_s)
        self.rate += rate

    def within(self, band_hz: tuple[float, float]) -> Tables:
        """The same with both signals limited alike to a band: half of an amplitude is left at its ends, and hardly
        anything beyond. An end of 0, or near half the sampling rate, limits nothing."""
        low_hz, high_hz = band_hz
        to_hz = STOP_BAND / HALVED * high_hz if high_hz < HIGHEST_LIMIT * self.rate_hz else None
        other = copy(self)
        other._making = replace(self._making, settings=replace(self._making.settings, from_hz=low_hz, to_hz=to_hz))
        return other

    def of_any_response(self, lag_s: float) -> list[Window]:
        """Windows that tell the response of each band by itself: no limit refuses what another response may explain,
        and no motion leaks from band to band."""
        settings = self._making.settings
        return self._make(replace(settings, limits=settings.limits.of_any_response, taper=HANN), lag_s)

    def _make(
        self,
        settings: Settings,
        lag_s: float,
        response: Response = FLAT,
        progress: Callable[[float], Any] | None = None,
    ) -> list[Window]:
        floor = self._rest_floor()
        windows: list[Window] = []
        for interval in self.poses:
            found = [
                w
                for piece in self._pieces(interval)
                for w in self._windows(interval, piece, lag_s, response, floor, settings)
            ]
            windows += found or [_nothing(interval, "no samples of the sensor, or none of the reference, in this pose")]
            if progress is not None:
                progress(interval.stop_s - interval.start_s)
        return windows

    def _pieces(self, interval: PoseInterval) -> Iterator[tuple[float, float]]:
        longest_s, guard_s = self._making.settings.limits.longest_s, self._making.guard_s
        first_s, end_s = self._sensor.span_s  # there are no windows outside, however long a pose is said to be
        for start_s, stop_s in self._recorded(interval.start_s, min(interval.stop_s, end_s + guard_s)):
            yield from pieces_of(start_s, stop_s, longest_s, guard_s, after_s=first_s - longest_s)

    def _recorded(self, start_s: float, stop_s: float) -> Iterator[tuple[float, float]]:
        """From when to when in s, between these times, neither the sensor nor the reference was off."""
        off_s = self._sensor.off_s + ([] if self._reference is None else self._reference.off_s)
        for from_s, to_s in sorted(off_s):
            if from_s < stop_s and to_s > start_s:
                if from_s > start_s:
                    yield start_s, from_s
                start_s = to_s
        if start_s < stop_s:
            yield start_s, stop_s

    def _windows(
        self,
        interval: PoseInterval,
        span_s: tuple[float, float],
        lag_s: float,
        response: Response,
        floor: Array | None,
        settings: Settings,
    ) -> list[Window]:
        sensor, reference = self._cut(interval, *span_s, lag_s, response)
        if sensor is None or (reference is None and interval.pose.direction.shape[1]):
            return []
        try:
            found = windows_of(
                interval.pose,
                sensor,
                reference,
                self._instrument,
                span_s,
                lag_s,
                settings,
                floor,
                response,
            )
        except Unusable as error:
            return [nothing_in(interval.pose, *span_s, str(error))]
        return [replace(w, sums=with_joined(w.sums, self._joined)) for w in found]

    def _cut(
        self, interval: PoseInterval, start_s: float, stop_s: float, lag_s: float = 0.0, response: Response = FLAT
    ) -> tuple[Samples | None, Samples | None]:
        if self._reference is None or not interval.pose.direction.shape[1]:
            return self._sensor.cut(start_s, stop_s), None
        around_s = margin_s(self._instrument, self._reference.clock.rate_hz) + response.reach_s
        sensor = self._sensor.cut(start_s - 0.5 * around_s, stop_s + 0.5 * around_s)
        return sensor, self._reference.cut(start_s - lag_s - around_s, stop_s - lag_s + around_s)

    def runs(self) -> Iterator[tuple[Points, Window]]:
        """Windows with motion and all their samples, not filtered, for methods that need more than sums."""
        settings = replace(self._making.settings, limit_band=False)
        for interval in self.poses:
            for piece in self._pieces(interval):
                found = self._aligned(interval, *piece, 0.0, settings)
                if found is None:
                    continue
                for window in motion_windows(
                    interval.pose, found.points, settings.limits, leave_out=settings.leave_out
                ):
                    first = int(np.searchsorted(found.points.time_s, window.start_s, side="left"))
                    stop = int(np.searchsorted(found.points.time_s, window.stop_s, side="right"))
                    yield found.points.part(first, stop), window

    def _stretches(self) -> Iterator[tuple[Array, Array, Array]]:
        """Times (n,) and evenly spaced samples of the sensor (n, 3) and of the reference (n, m) where there is motion,
        not filtered.

        Missing samples are interpolated.
        """
        settings = replace(self._making.settings, limit_band=False)
        for interval in self.poses:
            for piece in self._pieces(interval):
                found = self._aligned(interval, *piece, 0.0, settings)
                if found is not None:
                    t, V, u, *_ = found.points
                    even_s = np.arange(t[0], t[-1], 1.0 / self.rate_hz)
                    yield even_s, _interpolated(even_s, t, V), _interpolated(even_s, t, u)

    def points(self, interval: PoseInterval, start_s: float, stop_s: float, lag_s: float = 0.0) -> Points | None:
        """Samples of the sensor from `start_s` to `stop_s`, knocks included.

        With a reference: those with a reference value, at its times.
        """
        if interval.pose.direction.shape[1]:
            every = replace(self._making.settings, leave_out=False)
            found = self._aligned(interval, start_s, stop_s, lag_s, every)
            return None if found is None else found.points
        sensor = self._sensor.cut(start_s, stop_s)
        if sensor is None:
            return None
        whole = np.isfinite(sensor.values).all(axis=1)
        nothing = np.empty((int(whole.sum()), 0))
        return Points(sensor.time_s[whole], sensor.values[whole], nothing, nothing)

    def _aligned(
        self, interval: PoseInterval, start_s: float, stop_s: float, lag_s: float, settings: Settings
    ) -> Aligned | None:
        sensor, reference = self._cut(interval, start_s, stop_s, lag_s)
        if sensor is None or reference is None:
            return None
        return aligned(sensor, reference, self._instrument, (start_s, stop_s), lag_s, settings)

    def _rest_floor(self) -> Array | None:
        """The usual noise of the sensor at rest: the median over the pieces of all static poses."""
        at_rest = [interval for interval in self.poses if not interval.pose.direction.shape[1]]
        found = []
        for samples in (self._sensor.cut(*piece) for interval in at_rest for piece in self._pieces(interval)):
            V = np.empty((0, 3)) if samples is None else samples.values
            sd = rest_sd(V[np.isfinite(V).all(axis=1)], self.rate_hz)
            if sd is not None:
                found.append(sd)
        return np.asarray(np.median(found, axis=0)) if found else None


def _check_overlap(sensor: SensorTable, reference: ReferenceTable | None, poses: Sequence[PoseInterval]) -> None:
    spans = [(t.name, *ends_s(t.time_s)) for t in (sensor, reference) if t is not None]
    if poses:
        spans.append(("the poses", min(p.start_s for p in poses), max(p.stop_s for p in poses)))
    if max(s for _, s, _ in spans) >= min(e for _, _, e in spans):
        told = ", ".join(f"{name} from {moment(start)} to {moment(stop)}" for name, start, stop in spans)
        raise InputError("they do not overlap in time", f"their times must be on one scale: {told}{_zone(spans)}")


def _zone(spans: Sequence[tuple[str, float, float]]) -> str:
    """A hint where all times are dates; they may be those of different zones."""
    if min(start for _, start, _ in spans) <= FIRST_DATE_S:
        return ""
    return (
        "; a date without a zone is taken as UTC: where it is local time, write its offset behind the name of its "
        "column, as 'Time UTC+02:00'"
    )


def _interpolated(at_s: Array, time_s: Array, values: Array) -> Array:
    return np.column_stack([np.interp(at_s, time_s, x) for x in values.T])


def _nothing(interval: PoseInterval, reason: str) -> Window:
    return nothing_in(interval.pose, interval.start_s, interval.stop_s, reason)
