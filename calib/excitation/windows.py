"""Windows of known excitation, each with its verdict, from samples during which the sensor stays in one pose.

Motion is detected in the reference's samples, rests in the sensor's. calib.excitation.window_verdict has the limits
that a window must meet to be used.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import geometry
from calib.excitation import detection
from calib.excitation.band_to_keep import LEAST_MOTION_MPS2
from calib.excitation.motion_numbers import motion_numbers
from calib.excitation.rests import find_rests
from calib.excitation.steadiness import nonlinearity, step
from calib.excitation.window_verdict import DEFAULT_LIMITS, Limits, Verdict, judge
from calib.model import Array, BandSums, Pose, Window, WindowSums, own_channels
from calib.signal.band import hanning
from calib.signal.order_statistics import median
from calib.signal.stamps import OFF_S
from calib.windows.bands import band_sums
from calib.windows.sums import pool, window_sums

CALM = "the reference is calm here"  # compared with the rest of the samples
CLEARLY = 0.8  # least share of the power of that output, that is motion
FOLLOWS = 0.3  # least share of what the motion moves, as amplitudes, that the output along it has
CYCLES, SLOW = 5, 1e-2  # of a motion that is no straight line; of its power, what may be slower
SHORTEST_QUIET_S = 1.0  # a shorter pause makes no window of kind "quiet"


Kind = Literal["motion", "rest", "quiet"]


class Points(NamedTuple):
    """Samples of the sensor with the reference at the same times.

    `time_s` (n,) rises; `V` (n, 3) in output unit; `u` (n, m) in m/s2 and its derivative `du` (n, m) in m/s3. `struck`
    (n,) flags samples that are known to be knocks: in V is what the motion explains in their places. None where none
    are known. `most_noise` (m,): the SD that the reference's white noise in u does not exceed, as its own samples tell;
    None where they do not.
    """

    time_s: Array
    V: Array
    u: Array
    du: Array
    struck: NDArray[np.bool_] | None = None
    most_noise: Array | None = None

    def at(self, which: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Points:
        """Some of the samples."""
        struck = None if self.struck is None else self.struck[which]
        return Points(self.time_s[which], self.V[which], self.u[which], self.du[which], struck, self.most_noise)

    def part(self, first: int, stop: int) -> Points:
        """The samples [first, stop)."""
        return self.at(slice(first, stop))

    @property
    def own_u(self) -> Array:
        """(n, k) u of the reference's own channels, without their integrals (calib.signal.corner)."""
        return self.u[:, : own_channels(self.u.shape[1])]

    def not_noisier(self, found: Array) -> Array:
        """(k,) SD of the white noise of the reference's own channels in u, of which the samples of all channels seem to
        have `found` (m,)."""
        found = found[: self.own_u.shape[1]]
        return found if self.most_noise is None else np.minimum(found, self.most_noise)

    @property
    def without_line(self) -> Points:
        """The samples beside an AC-coupled reference without their straight lines over time; others as they are, and
        those of a motion that makes fewer than CYCLES.

        The zero error of the reference gives its integral a straight line, which is taken out over all samples that are
        integrated together. Of these a loud part tells that line worse than the motion of a quiet part needs it.
        """
        if self.own_u.shape[1] == self.u.shape[1] or len(self.u) < 2:
            return self
        line = self.time_s - self.time_s.mean()
        unit = line / float(line @ line)
        V, u, du = (own - np.outer(line, unit @ own) for own in (self.V, self.u, self.du))
        power = np.sum(np.abs(np.fft.rfft((V - V.mean(axis=0)) * hanning(len(V))[:, None], axis=0)) ** 2, axis=1)
        cycles = int(np.searchsorted(np.cumsum(power), SLOW * power.sum()))  # that the motion makes at least
        return self if cycles < CYCLES else self._replace(V=V, u=u, du=du)

    def within(self, start_s: float, stop_s: float) -> Points:
        """The samples from one time to another, both included."""
        first, stop = np.searchsorted(self.time_s, start_s), np.searchsorted(self.time_s, stop_s, "right")
        return self.part(int(first), int(stop))


def motion_windows(
    pose: Pose, points: Points, limits: Limits = DEFAULT_LIMITS, *, leave_out: bool = True, taper: float = 0.0,
    before: Points | None = None,
) -> list[Window]:  # fmt: skip
    """The windows in samples of one pose: kind "motion" where the reference moves, kind "quiet" where it hardly moves.

    If `leave_out` is false, the sums hold all points, knocks included (Method 3 as printed). With a `taper` (the share
    of a window at each end), windows hold sums in bands of frequency as well. `before`: the samples before a filter,
    in which the motion begins and stops; what passed the filter may swell and fade.
    """
    seen = points if before is None else before
    noise, windows = detection.white_noise(seen.u), []
    for kind, first, stop in motion_parts(seen.u, _rate(seen.time_s), noise):
        known = points.not_noisier(noise) if stop - first == len(points.u) and before is None else None
        part = points.within(seen.time_s[first], seen.time_s[stop - 1])
        windows += judged(kind, pose, part, limits, leave_out=leave_out, taper=taper, noise=known)
    return windows


def motion_parts(u: Array, rate_hz: float, noise: Array) -> list[tuple[Kind, int, int]]:
    """Parts (kind, first, stop) of a reference's samples u (n, m), cut where it begins or stops to move.

    Waves of seconds are calm at each change of sign, for longer than a pause may be. The integrals of a reference
    (calib.signal.corner) show hardly anything but the waves: its own channels tell as well, then.
    `noise` (m,) is the SD of its white noise. Pauses shorter than SHORTEST_QUIET_S make no part.
    """
    m, stretches = own_channels(u.shape[1]), detection.moving(u, rate_hz, noise)
    if m < u.shape[1] and detection.half_period_s(u[:, :m], rate_hz) > detection.BRIDGE_S:
        stretches = _either(stretches, detection.moving(u[:, :m], rate_hz, noise[:m]))
    edges = [0, *itertools.chain(*stretches), len(u)]
    parts: list[tuple[Kind, int, int]] = []
    for k, (first, stop) in enumerate(itertools.pairwise(edges)):
        if k % 2:
            parts.append(("motion", first, stop))
        elif stop - first >= SHORTEST_QUIET_S * rate_hz or len(edges) == 2:
            parts.append(("quiet", first, stop))
    return parts


def _either(one: list[detection.Stretch], other: list[detection.Stretch]) -> list[detection.Stretch]:
    """What lies in a stretch of either list."""
    found: list[detection.Stretch] = []
    for first, stop in sorted([*one, *other]):
        if found and first <= found[-1][1]:
            found[-1] = found[-1][0], max(found[-1][1], stop)
        else:
            found.append((first, stop))
    return found


def judged(
    kind: Kind, pose: Pose, points: Points, limits: Limits = DEFAULT_LIMITS, *, leave_out: bool = True,
    taper: float = 0.0, noise: Array | None = None,
) -> list[Window]:  # fmt: skip
    """The windows of one part (see `motion_parts`), with their verdicts.

    The part is cut where samples are missing, and into windows not longer than `limits.longest_s`. `noise` (m,) is the
    SD of the white noise of all its u, None where nobody has found it yet.
    """
    windows = []
    for first, stop in _unbroken(points.time_s):
        longest = round(limits.longest_s * _rate(points.time_s[first:stop]))
        for a, b in _pieces(first, stop, longest):
            part = points.part(a, b).without_line
            known = noise if b - a == len(points.time_s) else None
            windows.append(_motion(kind, pose, part, _rate(part.time_s), limits, leave_out, taper, noise=known))
    return windows


def rest_window(
    pose: Pose,
    time_s: Array,
    V: Array,
    limits: Limits = DEFAULT_LIMITS,
    *,
    floor: Array | None = None,
    leave_out: bool = True,
) -> Window:
    """One window of all rests in the samples of one static pose: `time_s` (n,), `V` (n, 3), n >= 2.

    Samples during motion are left out. `floor` (3,) is the SD that the sensor has at rest in other positions
    (`rest_sd`), in output unit: with it, a sensor that shakes all the time is not taken for one at rest.
    """
    rate_hz = _rate(time_s)
    rests = find_rests(V, rate_hz)
    if not rests:
        numbers = {"points": float(len(V)), "left_out_pct": 0.0}
        return _window("rest", pose, time_s, _rest_sums(V, rate_hz, limits), _never(numbers), 0)
    resting = np.concatenate([np.arange(a, b) for a, b in rests])
    t, v = time_s[resting], V[resting]
    finest = detection.least_step(v)
    struck, residual = detection.knocked(v, np.ones((len(v), 1)), finest)
    clean = sums = _rest_sums(v[~struck], rate_hz, limits)
    if not leave_out:
        sums = _rest_sums(v, rate_hz, limits)
    numbers = {"at_rest_pct": 100.0 * len(v) / len(V)}
    gravity_mps2, mean = float(np.linalg.norm(pose.gravity_mps2)), float(np.linalg.norm(v.mean(axis=0)))
    if gravity_mps2 > 0.0 and mean > 0.0:
        changed, u_changed = step(residual, rate_hz)
        numbers |= {"step_mps2": changed * gravity_mps2 / mean, "u_step_mps2": u_changed * gravity_mps2 / mean}
    if floor is not None:
        least = np.maximum(np.maximum(floor, finest), np.finfo(float).tiny)
        numbers["sd_over_floor"] = float(np.max(_within_sd(clean) / least))
    left_out = int(struck.sum()) if leave_out else 0
    return _window("rest", pose, t, sums, judge(sums, struck, numbers, limits), left_out)


def at_rest(points: Points) -> bool:
    """Whether a sensor and a reference that feels gravity rest for at least half of these samples."""
    rests = find_rests(points.V, _rate(points.time_s))
    resting = sum(b - a for a, b in rests)
    power = sum(float((b - a) * np.var(points.u[a:b], axis=0).sum()) for a, b in rests)
    return 2 * resting >= len(points.V) and power <= resting * LEAST_MOTION_MPS2**2


def still_window(pose: Pose, points: Points, limits: Limits = DEFAULT_LIMITS, *, leave_out: bool = True) -> Window:
    """The window of all rests in samples, n >= 2, of a sensor and the reference beside it.

    The reference feels gravity as the sensor does, so the means of both tell; what else the reference shows is noise.
    """
    rests = find_rests(points.V, _rate(points.time_s))
    if not rests:
        sums = _sums(points.V, points.u, points.du, _rate(points.time_s), limits)
        numbers = {"points": float(len(points.V)), "left_out_pct": 0.0}
        return _window("rest", pose, points.time_s, sums, _never(numbers), 0)
    resting = np.concatenate([np.arange(a, b) for a, b in rests])
    t, V, u, du, known, _ = points.at(resting)
    struck, _ = detection.knocked(np.asfortranarray(V), np.ones((len(V), 1)), detection.least_step(V))
    struck = struck if known is None else struck | known
    kept = ~struck if leave_out else np.ones(len(V), dtype=bool)
    sums = _sums(V[kept], u[kept], du[kept], _rate(points.time_s), limits)
    m = sums.reference_channels
    power = np.diag(sums.scatter.sum(axis=0))[: 2 * m]
    numbers = {"at_rest_pct": 100.0 * len(V) / len(points.V)}
    verdict = judge(sums, struck, numbers, limits)
    window = _window("rest", pose, t, sums, verdict, int(struck.sum()) if leave_out else 0)
    return replace(window, reference_noise=np.sqrt(power / sums.count.sum()).reshape(2, m))


def rests_anywhere(time_s: Array, V: Array, gravity_mps2: float, limits: Limits = DEFAULT_LIMITS) -> list[Window]:
    """A window for each rest in samples of a sensor in unknown positions, for `calib.adjustment.norm_fit.norm_fit`.

    `time_s` (n,) in s, `V` (n, 3) in output unit, `gravity_mps2` the magnitude of gravity. The pose of each window has
    gravity along z in place of its unknown direction; a norm fit does not use the pose.
    """
    steps = np.diff(time_s)
    off = steps[steps > OFF_S]  # nothing was recorded meanwhile
    rate_hz = float((len(steps) - len(off)) / (time_s[-1] - time_s[0] - off.sum()))
    windows = []
    for k, (first, stop) in enumerate(find_rests(V, rate_hz)):
        pose = geometry.at_rest([0.0, 0.0, gravity_mps2], position=f"rest {k + 1}")
        v = V[first:stop]
        struck, _ = detection.knocked(v, np.ones((len(v), 1)), detection.least_step(v))
        sums = _rest_sums(v[~struck], rate_hz, limits)
        verdict = judge(sums, struck, {}, limits)
        windows.append(_window("rest", pose, time_s[first:stop], sums, verdict, int(struck.sum())))
    return windows


def rest_sd(V: Array, rate_hz: float) -> Array | None:
    """SD (3,) of V (n, 3) within a rest, the median over all rests; None if there is no rest."""
    rests = find_rests(V, rate_hz)
    return np.median([V[a:b].std(axis=0) for a, b in rests], axis=0) if rests else None


def _motion(
    kind: Kind,
    pose: Pose,
    points: Points,
    rate_hz: float,
    limits: Limits,
    leave_out: bool,
    taper: float,
    stepped: tuple[float, float] | None = None,
    noise: Array | None = None,
) -> Window:
    """One window. It is judged without the knocks, also where they stay in its sums.

    Where knocks lie together, whole segments are left out; the limits are held against the other segments. But after a
    slip the shorter part of a window looks like knocks: `stepped` is the step of the mean over all segments.
    """
    t, u, du, known = points.time_s, points.u, points.du, points.struck
    V = np.asfortranarray(points.V)  # medians and extremes of an axis are several times faster this way
    if len(V) < max(limits.least_points, 2 * u.shape[1] + 2):
        sums = _sums(V, u, du, rate_hz, limits)
        return _window(kind, pose, t, sums, judge(sums, np.zeros(len(V), dtype=bool), {}, limits), 0)
    basis = np.vstack([np.ones(len(u)), u.T, du.T]).T
    finest = detection.least_step(V)
    struck, residual = detection.knocked(V, basis, finest)
    struck = struck if known is None else struck | known
    if struck.all():  # no response of the sensor makes such a window a sound one
        sums, limits = _sums(V, u, du, rate_hz, limits), replace(limits, most_left_out_pct=0.0)
        return _window(kind, pose, t, sums, judge(sums, struck, {}, limits), 0)
    stepped = stepped or step(residual, rate_hz)
    sound = _sound(struck, rate_hz, limits)
    if leave_out and not sound.all():
        rest = _motion(kind, pose, points.at(sound), rate_hz, limits, leave_out, 0.0, stepped)
        bands = _bands(points, struck | ~sound, residual, rate_hz, taper) if taper and rest.used else None
        return _without_segments(replace(rest, bands=bands), int((~sound).sum()))
    clean = sums = _sums(V, u, du, rate_hz, limits)
    kept: slice | NDArray[np.bool_] = slice(None)
    if struck.any():
        kept, noise = ~struck, None
        clean = _sums(V[kept], u[kept], du[kept], rate_hz, limits)
        if leave_out:
            sums = clean
    way = _along(pose, V, residual)
    noise = points.not_noisier(detection.white_noise(points.own_u[kept])) if noise is None else noise
    numbers = motion_numbers(clean, basis[kept], V[kept] @ way, rate_hz, stepped, limits, noise)
    numbers |= nonlinearity(V @ way, residual @ way, rate_hz)
    numbers["stuck_axes"] = float(np.sum(np.ptp(V, axis=0) == 0.0))
    numbers["clipped_points"] = float(detection.clipped(V, residual, finest))
    verdict = judge(sums, struck, numbers, limits)
    if kind == "quiet" and verdict.used:
        verdict = Verdict(False, CALM, verdict.numbers)
    window = _window(kind, pose, t, sums, verdict, int(struck.sum()) if leave_out else 0)
    if not (taper and verdict.used):
        return window
    return replace(window, bands=_bands(points, struck, residual, rate_hz, taper))


def _along(pose: Pose, V: Array, residual: Array) -> Array:
    """(3, A) the outputs that a window is judged by: all, or of a uniaxial reference the one along its motion, where
    the motion moves that one, and hardly anything else does. The others show motion across, which nobody measures."""
    if own_channels(pose.direction.shape[1]) != 1:
        return np.eye(3)
    way = pose.direction[:, :1]
    alone, moved = V @ way, V - residual
    along = float(np.var(moved @ way))
    seen = along > FOLLOWS**2 * float(np.var(moved, axis=0).sum()) and along > CLEARLY * float(np.var(alone))
    return way if seen else np.eye(3)


def _bands(
    points: Points, left_out: NDArray[np.bool_], residual: Array, rate_hz: float, taper: float
) -> BandSums | None:
    """The sums in bands of a window's points. Without those that are `left_out` (n,) the others would not be evenly
    spaced: the window's own regression, from which V has this `residual` (n, 3), takes their places."""
    whole = np.where(left_out[:, None], points.V - residual, points.V) if left_out.any() else points.V
    return band_sums(points.u, points.du, whole, rate_hz, taper)


def _sound(struck: NDArray[np.bool_], rate_hz: float, limits: Limits) -> NDArray[np.bool_]:
    """Points (n,) that are in no segment full of knocks; all where the limit is kept, or no segment would be left."""
    every = np.ones(len(struck), dtype=bool)
    if 100.0 * struck.mean() <= limits.most_left_out_pct:
        return every
    edges = _edges(len(struck), rate_hz, limits)
    count = np.diff(edges)
    full = 100.0 * np.add.reduceat(struck, edges[:-1], dtype=float) > limits.most_left_out_of_segment_pct * count
    return every if full.all() else np.repeat(~full, count)


def _without_segments(window: Window, points: int) -> Window:
    """The window of what was left when segments of so many points were left out."""
    dropped = points + window.numbers.get("dropped_points", 0.0)
    numbers = {**window.numbers, "dropped_points": float(dropped)}
    return replace(window, left_out=window.left_out + points, numbers=numbers)


def _never(numbers: Mapping[str, float]) -> Verdict:
    return Verdict(False, "the sensor is never at rest here", numbers)


def _sums(V: Array, u: Array, du: Array, rate_hz: float, limits: Limits) -> WindowSums:
    """Sums by segments of `segment_s`; what is left over at the end goes into the last one."""
    return window_sums(u, du, V, _edges(len(V), rate_hz, limits))


def _edges(n: int, rate_hz: float, limits: Limits) -> NDArray[np.int64]:
    """(K + 1,) where the segments of n samples begin, and n."""
    size = max(1, round(limits.segment_s * rate_hz))
    return np.append(np.arange(0, max(n - size // 2, 1), size), n)


def _rest_sums(V: Array, rate_hz: float, limits: Limits) -> WindowSums:
    return _sums(V, np.empty((len(V), 0)), np.empty((len(V), 0)), rate_hz, limits)


def _within_sd(sums: WindowSums) -> Array:
    """(3,) pooled SD of V within segments, in output unit."""
    return np.asarray(np.sqrt(np.diagonal(sums.scatter[:, -3:, -3:].sum(axis=0)) / sums.count.sum()))


def _window(
    kind: Kind,
    pose: Pose,
    time_s: Array,
    sums: WindowSums,
    verdict: Verdict,
    left_out: int,
) -> Window:
    points = int(pool(sums).count[0])
    start, stop = float(time_s[0]), float(time_s[-1])
    return Window(start, stop, pose, sums, verdict.used, verdict.reason, points, left_out, kind, verdict.numbers)


def _unbroken(time_s: Array) -> Iterator[tuple[int, int]]:
    """[first, stop) of each stretch without missing samples: a time step above 2.5 times the median ends a stretch."""
    if len(time_s) < 2:
        return
    steps = np.diff(time_s)
    # No median is needed where no step is long: it is no less than the smallest step.
    long = steps.max() > 2.5 * steps.min()
    cuts = np.flatnonzero(steps > 2.5 * median(steps)) + 1 if long else np.zeros(0, dtype=np.int64)
    yield from ((a, b) for a, b in itertools.pairwise([0, *cuts.tolist(), len(time_s)]) if b - a > 1)


def _pieces(first: int, stop: int, longest: int) -> Iterator[tuple[int, int]]:
    """[first, stop) of equal pieces of at most `longest` samples; a piece has at least two samples."""
    if stop - first > 1:
        count = min(-(-(stop - first) // max(longest, 2)), (stop - first) // 2)
        yield from itertools.pairwise(np.linspace(first, stop, count + 1).round().astype(int).tolist())


def _rate(time_s: Array) -> float:
    return float((len(time_s) - 1) / (time_s[-1] - time_s[0]))
