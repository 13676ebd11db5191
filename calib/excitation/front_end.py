"""The one front end: samples of a sensor and of a reference, with their clocks, become windows.

Files and live streams both call it. The steps: the reference becomes an acceleration at the sensor's sample times;
stated corners of AC-coupled instruments are undone; where the reference's noise matters both signals are limited to the
band of the motion; the windows found in them get their verdicts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from calib.excitation import detection
from calib.excitation.band_to_keep import FILTER_BAND, LEAST_MOTION_MPS2, band_to_keep
from calib.excitation.clock_bend import ClockBend, clock_bend
from calib.excitation.disturbance import NoiseFilter, against_noise, not_more_than_incoherent
from calib.excitation.hum import hum_hz, without_lines
from calib.excitation.knocks import knocks
from calib.excitation.sustained import sustained_hz
from calib.excitation.turning import feels_gravity, is_turned, standing_parts
from calib.excitation.window_verdict import DEFAULT_LIMITS, Limits, disproportionate
from calib.excitation.windows import CALM, Points, at_rest, motion_windows, rest_window, still_window
from calib.model import U_NOISE, Array, Pose, Window, WindowSums, own_channels
from calib.signal.band import band_above_noise, folds, lowpass, unfolded, without_short_holes, without_slow
from calib.signal.corner import integral_of_motion, with_integral, without_corner
from calib.signal.glitches import glitches
from calib.signal.holes import Mask
from calib.signal.instrument import Instrument
from calib.signal.resampling import (
    HALF,
    as_slice,
    differentiate,
    differentiator_lost,
    resample,
)
from calib.signal.response import FLAT, Response, passed
from calib.signal.samples import Samples
from calib.windows.bands import TAPER, beside_noise, beside_reference_noise

# Samples beyond a window's ends, the reference's (the sensor's half of it): half the taps of resampling, of
# differentiating and of the low-pass filter at 100 Hz and above.
LEAST_MARGIN_S = 1.0
MOST_MARGIN_S = 5.0  # a second derivative at 10 Hz takes 4.2 s
# Of many holes pieces of a second are left: too short for the reference's noise, and for type A by segments.
MOST_MISSING_PCT = 5.0
# A sensor that follows the motion better, with fewer knocks, needs no other weights of the frequencies.
COHERENT, KNOCKED_PCT = 0.999, 1.0
CALM_SHARE = 0.25  # of the time that moves as well, but weakly: a window is cut into pieces where shocks end
# Of the motion in a window: with fewer, its spectrum is that of the window's ends, and it shows no direction but one.
FEWEST_CYCLES = 2.0
LEAST_CYCLES, LEAST_LONG_CYCLES, LONG_S = 1.0, 0.5, 10.0  # a few ms of lag bend a long turn less than a short one
SLOW_HZ, SLOW_SHARE = 10.0, 0.8  # means of so long a time keep so much of a slow motion, and little of the noise


class Unusable(ValueError):  # noqa: N818 - said of samples
    """These samples make no window; the message says which device cannot take part, and why."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How windows are made. Method 3 as printed needs `leave_out` False (every point is kept) and `limit_band` False.

    `limits`: what a window must keep to be used. `bands`: windows with motion hold sums in bands as well, for which the
    share `taper` of them is tapered at each end. `to_hz`: both signals are limited so that no motion above it is left;
    None leaves it. `from_hz`: what is slower is filtered out of both likewise, but for the means; 0 leaves it.
    `most_noise`: of each channel of the reference, in its own SI unit per root Hz, the density that its noise does not
    exceed as other windows tell; () where nothing told it.
    """

    limits: Limits = DEFAULT_LIMITS
    leave_out: bool = True
    limit_band: bool = True
    bands: bool = False
    to_hz: float | None = None
    from_hz: float = 0.0
    taper: float = TAPER
    most_noise: tuple[float, ...] = ()


DEFAULT_SETTINGS = Settings()


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """The sensor's samples with the reference at their times, in the band of the motion, and the noise of both.

    `reference_noise` (2, m) and `u_noise` as in calib.model.Window; `sensor_noise` (3,) is the rms of V's white noise
    in all frequencies together, 0 where none shows it alone. `clipped_points`: samples at the end of the sensor's
    range, counted before the filter, which hides them. `independent`: the share of the points that the filter leaves
    independent; filled samples are none. `band_hz`: where the filter ends, None where there is none. `filled`: how many
    samples of a device were missing and filled, by the name that this number has in a window; empty where none was.
    """

    points: Points
    reference_noise: Array
    u_noise: float
    sensor_noise: Array
    clipped_points: int
    independent: float
    band_hz: float | None
    filled: Mapping[str, float] = field(default_factory=dict)


def margin_s(instrument: Instrument, rate_hz: float) -> float:
    """How many seconds of the reference beyond both ends of a stretch its windows need."""
    lost = differentiator_lost(rate_hz, instrument.derivatives) + HALF + 1
    return min(max(LEAST_MARGIN_S, lost / rate_hz), most_margin_s(instrument)) + instrument.known.reach_s(rate_hz)


def most_margin_s(instrument: Instrument) -> float:
    """The largest `margin_s` at any rate."""
    return (MOST_MARGIN_S if instrument.derivatives else LEAST_MARGIN_S) + instrument.known.most_reach_s


def windows_of(
    pose: Pose,
    sensor: Samples,
    reference: Samples | None,
    instrument: Instrument,
    span_s: tuple[float, float],
    lag_s: float = 0.0,
    settings: Settings = DEFAULT_SETTINGS,
    floor: Array | None = None,
    response: Response = FLAT,
) -> list[Window]:
    """The windows between two times in one pose, each with its verdict; empty where sensor and reference do not meet.

    `sensor` and `reference` hold the samples of `span_s` and of a margin around it (`margin_s`; for the sensor half of
    it is enough). The sensor's indications are taken to come late by `lag_s`, and to be what `response` makes of the
    motion. Without a reference the pose must be one at rest; `floor` (3,) is then the sensor's noise at rest elsewhere.
    Raises Unusable where a device cannot take part: the message says which one and why.
    """
    _check(sensor, sensor.device, 3)
    if reference is None:
        found = _rest(pose, sensor, span_s, settings, floor)
    else:
        name = f"the reference {reference.device}"
        _check(reference, name, pose.direction.shape[1])
        if reference.saturated:
            raise Unusable(f"{name} was at the end of its range")
        _check_holes(sensor, sensor.device)
        _check_holes(reference, name)
        found = _motion(pose, sensor, reference, instrument, span_s, lag_s, settings, response)
    if sensor.saturated:
        reason = "the sensor was at the end of its range"
        found = [replace(w, used=False, reason=w.reason or reason) for w in found]
    return found


def aligned(
    sensor: Samples,
    reference: Samples,
    instrument: Instrument,
    span_s: tuple[float, float],
    lag_s: float = 0.0,
    settings: Settings = DEFAULT_SETTINGS,
    response: Response = FLAT,
    against: NoiseFilter | None = None,
) -> Aligned | None:
    """Samples within `span_s` that have a reference, in m/s2; None where there are fewer than two.

    Where nothing is left out, the reference's glitches stay (see calib.signal.glitches). `against`: a filter that both
    signals pass besides.
    """
    rate_hz = reference.clock.rate_hz
    raw = reference.values / instrument.sensitivity
    odd = glitches(raw) if settings.leave_out else np.zeros(len(raw), dtype=bool)
    if instrument.derivatives:  # between the two sides of a step is no value: the hole is longer than those filled
        odd = np.convolve(odd, np.ones(3), "same") > 0.5
    raw[odd] = np.nan
    time_s = sensor.time_s
    if len(time_s) < 2:
        return None
    sensor_rate_hz = float((len(time_s) - 1) / (time_s[-1] - time_s[0]))
    m, inside, struck = raw.shape[1], _within(time_s, span_s), np.zeros(len(time_s), dtype=bool)
    beside = partial(_side_by_side, raw, sensor, reference, instrument, sensor_rate_hz, lag_s, response)
    as_measured = made = beside(sensor.values)
    shown = np.isfinite(made.columns).all(axis=1) & inside
    if settings.leave_out and settings.limit_band and not is_turned(made.columns[shown, 3 : 3 + m], sensor_rate_hz):
        struck, residual = knocks(made.columns, inside, sensor_rate_hz)
        if struck.any():
            made = beside(sensor.values - np.where(struck[:, None], residual, 0.0))
            shown = np.isfinite(made.columns).all(axis=1) & inside
    columns, raw, u, V, raw_filled, filled, noise_hz = made
    hums_hz = hum_hz(columns[shown, 3 : 3 + m], columns[shown, :3], sensor_rate_hz) if settings.limit_band else []
    if hums_hz:
        columns = without_lines(columns, sensor_rate_hz, hums_hz)
    rates_hz, together = (rate_hz, sensor_rate_hz), columns[np.isfinite(columns).all(axis=1) & inside, : 3 + m]
    most = np.array(settings.most_noise) if settings.most_noise else np.full(m, np.inf)
    band_hz, noise, u_noise = band_to_keep(raw, u, V, instrument, rates_hz, noise_hz, settings.to_hz, together, most)
    clipped, unfiltered = 0, as_measured.columns if struck.any() else columns
    filters_to_hz = band_hz if settings.limit_band else None
    if filters_to_hz is None:
        columns[filled] = np.nan  # without a filter, a filled sample would only repeat what the others tell
    columns, independent = _filtered(columns, sensor_rate_hz, filters_to_hz, settings, inside, against)
    if columns is not unfiltered:
        clipped = _clipped(unfiltered[np.isfinite(unfiltered).all(axis=1) & inside & ~filled])
    usable = np.isfinite(columns).all(axis=1) & inside
    if usable.sum() < 2:
        return None
    raw_inside = _within(reference.time_s, span_s) if raw_filled.any() or odd.any() else raw_filled
    independent *= (1.0 - _share(filled, usable)) * (1.0 - _share(raw_filled, raw_inside))
    counts = {
        "filled_samples": (filled & usable).sum(),
        "reference_filled_samples": (raw_filled & raw_inside).sum(),
        "reference_glitches": (odd & raw_inside).sum(),
        "hum_lines": len(hums_hz),
    }
    kept = as_slice(np.flatnonzero(usable))
    V_kept, u_kept, du_kept = np.split(columns.T[:, kept].T, [3, (3 + columns.shape[1]) // 2], axis=1)
    points = Points(time_s[kept], V_kept, u_kept, du_kept, struck[kept] if struck.any() else None)
    if u_noise > U_NOISE and not settings.limit_band:  # Method 3 as printed
        noise = np.zeros_like(noise)
    noise = noise if against is None else against.noise_left * against.reference_noise
    if settings.limit_band and u_noise <= U_NOISE:
        points = points._replace(most_noise=noise[0])
    noise = not_more_than_incoherent(noise, points.own_u, points.V, sensor_rate_hz, instrument.derivatives)
    told = {name: float(count) for name, count in counts.items() if count}
    sensor_noise = np.sqrt(0.5 * sensor_rate_hz) * band_above_noise(V, sensor_rate_hz)[1]
    return Aligned(points, noise, u_noise, sensor_noise, clipped, independent, filters_to_hz, told)


def _filtered(
    columns: Array, rate_hz: float, to_hz: float | None, settings: Settings, inside: Mask, against: NoiseFilter | None
) -> tuple[Array, float]:
    """The columns (n, k) after the filters that sensor and reference both pass, and the share of the points that these
    leave independent. `to_hz`: the band of the motion, None where nothing is filtered above it."""
    independent = 1.0
    if to_hz is not None:
        independent = min(1.0, 2.0 * FILTER_BAND * to_hz / rate_hz)
        columns = lowpass(columns, rate_hz, to_hz)
    if settings.from_hz and settings.limit_band:
        columns = without_slow(columns, rate_hz, settings.from_hz)
        independent = max(independent - 2.0 * settings.from_hz / rate_hz, 0.0)
    if against is not None:
        columns = against.passed(np.where(inside[:, None], columns, np.nan))  # beyond, the sensor may be turned
        independent = against.independent(FILTER_BAND * to_hz if to_hz else np.inf)
    return columns, independent


class _Beside(NamedTuple):
    """Sensor and reference side by side: `columns` (n, 3 + 2 k) are V, u and du at the sensor's times, NaN where one is
    missing; `raw` (r, m) and `V` (n, 3) before, their short holes filled, and which of them were; `u` (q, m) where
    the reference is known, `noise_hz` (2,) as in calib.signal.resampling.Resampled."""

    columns: Array
    raw: Array
    u: Array
    V: Array
    raw_filled: Mask
    filled: Mask
    noise_hz: Array


def _side_by_side(
    raw: Array,
    sensor: Samples,
    reference: Samples,
    instrument: Instrument,
    sensor_rate_hz: float,
    lag_s: float,
    response: Response,
    indications: Array,
) -> _Beside:
    """`raw` (r, m) are the reference's samples, `indications` (n, 3) the sensor's; NaN where they are missing."""
    rate_hz, m = reference.clock.rate_hz, raw.shape[1]
    raw, V, raw_filled, filled = without_short_holes(raw, indications, (rate_hz, sensor_rate_hz))
    u, lost = differentiate(raw, rate_hz, instrument.derivatives) if instrument.derivatives else (raw, 0)
    if instrument.has_corner:
        u = np.hstack([without_corner(u, rate_hz, instrument.corner_hz), integral_of_motion(u, rate_hz)])
        V = without_corner(V, sensor_rate_hz, instrument.sensor_corner_hz)
    u = unfolded(passed(instrument.known.passed(u, rate_hz), rate_hz, response), rate_hz, sensor_rate_hz)
    at = resample(u, reference.clock, sensor.time_s - lag_s, reference.first_index, lost)
    k, rows = u.shape[1], np.empty((3 + 2 * u.shape[1], len(V)))  # here and in what is kept: a channel is a row
    rows[:3], rows[3 : 3 + k], rows[3 + k :] = V.T, at.u.T, at.du.T
    rows[:, ~at.usable] = np.nan
    noise_hz = np.minimum(at.noise_hz, 0.5 * sensor_rate_hz) if folds(rate_hz, sensor_rate_hz) else at.noise_hz
    return _Beside(rows.T, raw, at.u[at.usable][:, :m], V, raw_filled, filled, noise_hz)


def nothing_in(pose: Pose, start_s: float, stop_s: float, reason: str) -> Window:
    """The unused window of a stretch in which there is nothing to judge."""
    m = pose.direction.shape[1]
    nothing = WindowSums(m, np.zeros(0), np.zeros((0, 2 * m + 3)), np.zeros((0, 2 * m + 3, 2 * m + 3)))
    return Window(start_s, stop_s, pose, nothing, False, reason, 0, 0, "motion" if m else "rest")


def _check(samples: Samples, device: str, axes: int) -> None:
    """Raises Unusable where a device cannot take part in a pose that needs this many axes of it."""
    if samples.axes != axes:
        has = f"{samples.axes} {'axis' if samples.axes == 1 else 'axes'}"
        raise Unusable(f"{device} has {has}, this pose needs {axes}")
    if not samples.in_time:
        raise Unusable(f"{device}: its sample numbers and arrivals do not make a clock")


def _check_holes(samples: Samples, device: str) -> None:
    """Raises Unusable where so much of a device is missing that what is left tells little."""
    missing_pct = 100.0 * float(np.mean(np.isnan(samples.values).any(axis=1)))
    if missing_pct > MOST_MISSING_PCT:
        raise Unusable(f"{missing_pct:.1f} % of the samples of {device} are missing, {MOST_MISSING_PCT:g} % at most")


def _rest(
    pose: Pose, sensor: Samples, span_s: tuple[float, float], settings: Settings, floor: Array | None
) -> list[Window]:
    time_s = sensor.time_s
    whole = np.isfinite(sensor.values).all(axis=1) & _within(time_s, span_s)
    if whole.sum() < 2:
        return []
    t, V = time_s[whole], sensor.values[whole]
    return [rest_window(pose, t, V, settings.limits, floor=floor, leave_out=settings.leave_out)]


def _against(found: Aligned, made: Sequence[Window], derivatives: int) -> NoiseFilter | None:
    """A filter against noise of the sensor, where its windows are knocked or hardly coherent, and where one helps."""
    knocked = any(100.0 * w.left_out > KNOCKED_PCT * (w.points + w.left_out) for w in made)
    if not knocked and not any(w.numbers.get("coherence", 1.0) < COHERENT for w in made):
        return None
    return against_noise(found.points, found.reference_noise, knocked=knocked, derivatives=derivatives)


def _motion(
    pose: Pose,
    sensor: Samples,
    reference: Samples,
    instrument: Instrument,
    span_s: tuple[float, float],
    lag_s: float,
    settings: Settings,
    response: Response,
) -> list[Window]:
    beside = reference, instrument, span_s, lag_s, settings, response
    if (found := aligned(sensor, *beside)) is None:
        return []
    bend = clock_bend(sensor, reference, found.points, found.independent) if settings.limit_band else None
    in_step = sensor if bend is None else bend.taken_out(sensor)
    if bend is not None:
        found = aligned(in_step, *beside) or found
    align = partial(aligned, in_step, *beside)
    stands, pose = pose, with_integral(pose) if instrument.has_corner else pose
    made = _beside(pose, found, settings)
    if settings.limit_band and settings.to_hz is None and (lasting_hz := _beside_shocks(found.points, made)):
        limited = replace(settings, to_hz=lasting_hz)
        within = _motion(stands, sensor, reference, instrument, span_s, lag_s, limited, response)
        if any(window.used for window in within):
            return within
    against = _against(found, made, instrument.derivatives) if settings.limit_band else None
    if against is not None and (better := align(against=against)) is not None:
        found, made = better, _beside(pose, better, settings, before=found.points)
    else:
        against = None
    u_lag_s = float(np.hypot(sensor.clock.u_offset_s, reference.clock.u_offset_s))
    taken = () if response.is_flat else response.terms
    made = [replace(_slow(_with_numbers(w, found), found.points), u_lag_s=u_lag_s, response=taken) for w in made]
    if bend is not None:
        made = [_with_bend(w, found.points, bend) for w in made]
    # Where the noise of the reference is stated, all other noise is the sensor's.
    sensor_noise = np.full(3, np.inf) if instrument.noise > 0.0 else found.sensor_noise
    return [_with_noise(w, sensor_noise, instrument.derivatives, against) for w in made]


def _with_bend(window: Window, points: Points, bend: ClockBend) -> Window:
    """The window with what is left open of the lag within it."""
    if not window.used or window.kind != "motion":
        return window
    return replace(window, lag_bend=bend.left_in(points.within(window.start_s, window.stop_s)))


def _with_noise(window: Window, sensor_noise: Array, derivatives: int, against: NoiseFilter | None) -> Window:
    """The window with the noise in its bands; `against`: the filter that they passed. The reference's noise is white in
    a quantity that was differentiated so often."""
    if window.bands is None:
        return window
    bands, noise = beside_noise(window.bands, sensor_noise), window.reference_noise
    if noise is not None:
        before = noise if against is None else against.before(noise)
        bands = beside_reference_noise(bands, before, window.points + window.left_out, derivatives)
    return replace(window, bands=bands if against is None else against.left_in(bands))


def _beside_shocks(points: Points, made: Sequence[Window]) -> float | None:
    """The upper end in Hz of the motion that lasts, where shocks beside it keep it from being used; else None.

    In such windows the output seems not to be proportional, or much of their time is calm compared with the shocks.
    """
    calm_s = sum(w.stop_s - w.start_s for w in made if w.reason == CALM)
    if not any(disproportionate(w.numbers) for w in made) and calm_s <= CALM_SHARE * (
        made[-1].stop_s - made[0].start_s
    ):
        return None
    rate_hz = (len(points.time_s) - 1) / (points.time_s[-1] - points.time_s[0])
    return sustained_hz(points.u[:, : own_channels(points.u.shape[1])], rate_hz)


def _beside(pose: Pose, found: Aligned, settings: Settings, before: Points | None = None) -> list[Window]:
    """Windows in motion and, where the reference feels gravity, at rest; each in one position against gravity.
    `before` as in motion_windows."""
    points, limits, leave_out = found.points, settings.limits, settings.leave_out
    taper = settings.taper if settings.bands else 0.0
    in_motion = partial(motion_windows, pose, limits=limits, leave_out=leave_out, taper=taper, before=before)
    if points.u.shape[1] != 3 or not feels_gravity(points.u):
        return in_motion(points)
    rate_hz = (len(points.time_s) - 1) / (points.time_s[-1] - points.time_s[0])
    standing = standing_parts(points.u, rate_hz)
    # Between two turns by hand, gravity is the excitation, and what hands shake is left out.
    turned = bool(standing) and standing != [(0, len(points.u))]
    windows: list[Window] = []
    for part in [points.part(a, b) for a, b in standing] or [points]:
        still = still_window(pose, part, limits, leave_out=leave_out) if turned and at_rest(part) else None
        made = [still] if still else in_motion(part)
        if standing and made and all(_silent(window) for window in made):
            made = [still_window(pose, part, limits, leave_out=leave_out)]
        windows += made
    return windows


def _silent(window: Window) -> bool:
    """Whether the reference did not move in a window: what it shows is its noise, or so little that it may be."""
    numbers = window.numbers
    level, coherence = numbers.get("reference_rms_mps2", np.inf), numbers.get("coherence", 0.0)
    if window.used or numbers.get("stuck_axes", 0.0) or level > LEAST_MOTION_MPS2:
        return False
    noisy = coherence < DEFAULT_LIMITS.least_coherence or level <= numbers["reference_rms_mps2_threshold"]
    return noisy or window.kind == "quiet"


def _with_numbers(window: Window, found: Aligned) -> Window:
    """The window with what was known before the filter, and what the filter left."""
    window = replace(window, independent=found.independent, numbers={**window.numbers, **found.filled})
    if window.kind == "rest":
        return window
    window = replace(window, reference_noise=found.reference_noise, u_noise=found.u_noise)
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


def _slow(window: Window, points: Points) -> Window:
    """A window in which the motion makes less than FEWEST_CYCLES, as a turn against gravity, without its bands: what is
    in them leaked from motion that is slower than the window, so it tells no response. Such motion leaves directions
    in which nothing moves: what the window shows to be noise of the reference counts there. With too few
    cycles the window is not used: what looks like a second direction is the bend of the first one."""
    if window.kind != "motion" or window.reference_noise is None or not window.points:
        return window
    u = points.within(window.start_s, window.stop_s).u[:, : own_channels(window.sums.reference_channels)]
    noise, rate_hz = detection.white_noise(u), (len(u) - 1) / (window.stop_s - window.start_s)
    cycles = _slow_cycles(u, rate_hz, noise)
    if cycles >= FEWEST_CYCLES:
        return window
    least = np.stack([noise, noise * np.pi / np.sqrt(3.0) * rate_hz])  # white to half of the rate
    needed, reason = LEAST_CYCLES if len(u) < LONG_S * rate_hz else LEAST_LONG_CYCLES, window.reason
    numbers = {**window.numbers, "cycles": cycles, "cycles_threshold": needed}
    if cycles < needed and window.used:
        reason = f"the motion is slow: it makes {cycles:.2g} cycles here, {needed:g} needed; turn it to and fro"
    return replace(
        window, bands=None, reference_noise=np.maximum(window.reference_noise, least), used=not reason, reason=reason,
        numbers=numbers,
    )  # fmt: skip


def _slow_cycles(u: Array, rate_hz: float, noise: Array) -> float:
    """How many cycles the motion u (n, m) makes, by its mean frequency; inf where it is not slow."""
    width = max(round(rate_hz / SLOW_HZ), 1)
    means = detection.averaged(u, width)
    moved = float(np.var(u[: len(means) * width], axis=0).sum() - np.sum(noise**2)) if len(means) else 0.0
    slow = float(np.var(means, axis=0).sum()) if len(means) > 1 else 0.0
    if slow < SLOW_SHARE * moved or not slow > 0.0:
        return float("inf")
    rate = np.diff(means, axis=0) * rate_hz / width
    return float(np.sqrt(np.mean(np.sum(rate**2, axis=1)) / slow)) * len(u) / rate_hz / (2.0 * np.pi)


def _clipped(columns: Array) -> int:
    """How many of the samples [V, u, du] (n, 3 + 2 m) are at an end of the sensor's range."""
    V = columns[:, :3]
    if len(columns) <= columns.shape[1] or not detection.may_be_clipped(V):
        return 0
    basis, finest = np.column_stack([np.ones(len(columns)), columns[:, 3:]]), detection.least_step(V)
    _, residual = detection.knocked(V, basis, finest)
    return detection.clipped(V, residual, finest)


def _share(some: Mask, of: Mask) -> float:
    """How much of the samples `of` are `some`."""
    return float((some & of).sum() / max(of.sum(), 1))


def _within(time_s: Array, span_s: tuple[float, float]) -> Mask:
    return np.asarray((time_s >= span_s[0]) & (time_s < span_s[1]))
