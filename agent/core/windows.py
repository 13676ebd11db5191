"""Windows out of streams: the reference at the sensor's sample times, both in the band of the motion, verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from agent.config import Channel
from agent.core.schedule import Piece
from agent.core.stream import Cut, DeviceStream
from calib.excitation import detection
from calib.excitation.window_verdict import DEFAULT_LIMITS, Limits
from calib.excitation.windows import Points, motion_windows, rest_window
from calib.model import Array, Pose, Window, WindowSums
from calib.signal.band import band_above_noise, lowpass, noise_in_band
from calib.signal.resampling import VELOCITY_BAND_HZ, differentiate, resample

# Samples beyond a window's ends, the reference's (the sensor's half of it): half the taps of resampling, of
# differentiating and of the low-pass filter at 100 Hz and above.
MARGIN_S = 1.0
# Of many holes pieces of a second are left: too short for the reference's noise, and for type A by segments.
MOST_MISSING_PCT = 5.0
NOISE_MATTERS = 1e-5  # of the motion's power: a filter against less of it would cost its ends for nothing
FILTER_BAND = 1.25  # times its band, where calib.signal.band.lowpass is 6 dB down
RESAMPLED_BAND = 0.35  # of the reference's rate, to which interpolation itself passes noise


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The windows of a stretch, in seconds since the sensor's first sample; its temperature, NaN where none is told."""

    windows: list[Window]
    temperature_degc: float = float("nan")

    def told(self, numbers: Mapping[str, float]) -> Found:
        """The same with numbers more in each window."""
        return replace(self, windows=[replace(w, numbers={**w.numbers, **numbers}) for w in self.windows])


def windows_in(piece: Piece, first_s: float, channel: Channel, streams: dict[str, DeviceStream], lag_s: float) -> Found:
    """The windows of a stretch in one pose, each with its verdict; one unused window where there is nothing to judge.

    `first_s` is the time of the sensor's first sample; the windows' times count from it. The sensor's indications are
    taken to come late by `lag_s`.
    """
    start_s, stop_s = first_s + piece.start_s, first_s + piece.stop_s
    cut = streams[channel.sensor].cut(start_s - 0.5 * MARGIN_S, stop_s + 0.5 * MARGIN_S)
    if cut is None:
        return Found([refused(piece, f"no samples of {channel.sensor}")])
    if fault := _fault(channel.sensor, cut, axes=3):
        return Found([refused(piece, fault)])
    if channel.reference is None:
        found = _rest(piece, cut, (start_s, stop_s), channel)
    else:
        reference = streams[channel.reference].cut(start_s - MARGIN_S, stop_s + MARGIN_S)
        if reference is None:
            return Found([refused(piece, f"no samples of the reference {channel.reference}")])
        if fault := _fault(f"the reference {channel.reference}", reference, axes=piece.pose.direction.shape[1]):
            return Found([refused(piece, fault)])
        if reference.saturated:
            return Found([refused(piece, f"the reference {channel.reference} was at the end of its range")])
        for device, samples in ((channel.sensor, cut), (f"the reference {channel.reference}", reference)):
            if fault := _gaps(device, samples):
                return Found([refused(piece, fault)])
        found = _motion(piece.pose, cut, reference, channel, (start_s, stop_s), lag_s)
    if not found:
        return Found([refused(piece, "the samples of sensor and reference do not meet")])
    if cut.saturated:
        found = [replace(w, used=False, reason=w.reason or "the sensor was at the end of its range") for w in found]
    found = [replace(w, start_s=w.start_s - first_s, stop_s=w.stop_s - first_s) for w in found]
    return Found(found, cut.temperature_degc)


def _fault(device: str, cut: Cut, axes: int) -> str:
    """Why a device cannot take part in a pose that needs this many axes of it; "" where it can."""
    if cut.axes != axes:
        return f"{device} has {cut.axes} {'axis' if cut.axes == 1 else 'axes'}, this pose needs {axes}"
    return "" if cut.in_time else f"{device}: its sample numbers and arrivals do not make a clock"


def _gaps(device: str, cut: Cut) -> str:
    """Why so much of a device is missing that what is left tells little; "" where it is not."""
    missing_pct = 100.0 * float(np.mean(np.isnan(cut.indications).any(axis=1)))
    if missing_pct <= MOST_MISSING_PCT:
        return ""
    return f"{missing_pct:.1f} % of the samples of {device} are missing, {MOST_MISSING_PCT:g} % at most"


def _rest(piece: Piece, cut: Cut, span_s: tuple[float, float], channel: Channel) -> list[Window]:
    time_s = cut.time_s
    whole = np.isfinite(cut.indications).all(axis=1) & _within(time_s, span_s)
    if whole.sum() < 2:
        return []
    return [rest_window(piece.pose, time_s[whole], cut.indications[whole], _limits(channel))]


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """The sensor's samples with the reference at their times, in the band of the motion, and the reference's noise.

    `clipped_points` at the end of the range: a filter leaves nothing of them to be seen, so they are counted before.
    `independent`: the share of the points that a filter leaves independent.
    """

    points: Points
    reference_noise: Array
    clipped_points: int
    independent: float


def signals(cut: Cut, reference: Cut, channel: Channel, span_s: tuple[float, float], lag_s: float) -> Signals | None:
    """Samples within `span_s` that have a reference, in m/s2; None where there are not two."""
    certificate, rate_hz = channel.certificate, reference.clock.rate_hz
    raw = reference.indications / certificate.sensitivity
    u, margin = differentiate(raw, rate_hz) if certificate.quantity == "velocity" else (raw, 0)
    time_s = cut.time_s
    at = resample(u, reference.clock, time_s - lag_s, reference.first_index, margin)
    columns = np.hstack([cut.indications, at.u, at.du])
    columns[~at.usable] = np.nan
    band_hz, noise = _band(raw, at.u[at.usable], channel, rate_hz)
    sensor_rate_hz = float((len(time_s) - 1) / (time_s[-1] - time_s[0])) if len(time_s) > 1 else 0.0
    clipped, independent = 0, 1.0
    if band_hz is not None:
        independent = min(1.0, 2.0 * FILTER_BAND * band_hz / sensor_rate_hz)
        clipped = _clipped(columns[np.isfinite(columns).all(axis=1) & _within(time_s, span_s)])
        columns = lowpass(columns, sensor_rate_hz, band_hz)
    usable = np.isfinite(columns).all(axis=1) & _within(time_s, span_s)
    if usable.sum() < 2:
        return None
    m = u.shape[1]
    kept = columns[usable]
    points = Points(time_s[usable], kept[:, :3], kept[:, 3 : 3 + m], kept[:, 3 + m :])
    return Signals(points, noise, clipped, independent)


def _clipped(columns: Array) -> int:
    """How many of the samples [V, u, du] (n, 3 + 2 m) are at an end of the sensor's range."""
    if len(columns) <= columns.shape[1]:
        return 0
    V, finest = columns[:, :3], detection.least_step(columns[:, :3])
    basis = np.column_stack([np.ones(len(columns)), columns[:, 3:]])
    _, residual = detection.knocked(V, basis, finest)
    return detection.clipped(V, residual, finest)


def _band(raw: Array, u: Array, channel: Channel, rate_hz: float) -> tuple[float | None, Array]:
    """Where to limit both signals, None where that gains nothing, and the reference's noise (2, m) in what is left."""
    certificate, m = channel.certificate, raw.shape[1]
    velocity = certificate.quantity == "velocity"
    found_hz, density = band_above_noise(raw, rate_hz)
    density = np.maximum(density, certificate.noise_mps2 / np.sqrt(0.5 * rate_hz))
    widest_hz = min(VELOCITY_BAND_HZ, RESAMPLED_BAND * rate_hz) if velocity else RESAMPLED_BAND * rate_hz
    unlimited = noise_in_band(density, widest_hz, differentiated=velocity)
    power = np.var(u, axis=0).max(initial=0.0) if len(u) else 0.0
    if found_hz is None or np.max(unlimited[0] ** 2, initial=0.0) <= NOISE_MATTERS * power:
        return None, unlimited.reshape(2, m)
    return found_hz, noise_in_band(density, min(FILTER_BAND * found_hz, widest_hz), differentiated=velocity)


def _motion(
    pose: Pose, cut: Cut, reference: Cut, channel: Channel, span_s: tuple[float, float], lag_s: float
) -> list[Window]:
    found = signals(cut, reference, channel, span_s, lag_s)
    if found is None:
        return []
    windows = motion_windows(pose, found.points, _limits(channel))
    u_lag_s = float(np.hypot(cut.clock.u_offset_s, reference.clock.u_offset_s))
    return [replace(_told(window, found), u_lag_s=u_lag_s) for window in windows]


def _told(window: Window, found: Signals) -> Window:
    """The window with what was known before the filter, and what the filter left."""
    window = replace(window, reference_noise=found.reference_noise, independent=found.independent)
    points, least = found.independent * window.points, float(DEFAULT_LIMITS.least_points)
    if window.used and points < least:
        # A regression on hardly more points than it has unknowns leaves no residual to judge it by.
        count = {"independent_points": points, "independent_points_threshold": least}
        reason = f"too few points: {points:.0f} are independent in the band of the motion, {least:.0f} needed"
        return replace(window, used=False, reason=reason, numbers={**window.numbers, **count})
    if not found.clipped_points:
        return window
    count = {"clipped_points": float(found.clipped_points), "clipped_points_threshold": 0.0}
    reason = window.reason or f"clipped: {found.clipped_points} points at the end of the sensor's range"
    return replace(window, used=False, reason=reason, numbers={**window.numbers, **count})


def _limits(channel: Channel) -> Limits:
    return Limits(longest_s=channel.window_s)


def _within(time_s: Array, span_s: tuple[float, float]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return np.asarray((time_s >= span_s[0]) & (time_s < span_s[1]))


def refused(piece: Piece, reason: str) -> Window:
    """The window of a piece in which there is nothing to judge."""
    m = piece.pose.direction.shape[1]
    nothing = WindowSums(m, np.zeros(0), np.zeros((0, 2 * m + 3)), np.zeros((0, 2 * m + 3, 2 * m + 3)))
    return Window(piece.start_s, piece.stop_s, piece.pose, nothing, False, reason, 0, 0)
