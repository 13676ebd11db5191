"""The clock behind a file's time stamps, whatever they are: a grid, arrivals of bursts, spread or jittery ones."""

from __future__ import annotations

import bisect
import itertools
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from calib.model import Array, Slices
from calib.signal.timing import FEWEST_FOR_RATE, HORIZON_S, ClockFit, Edge, IntArray, parabola

Kind = Literal["grid", "bursts", "spread", "jittery"]
SAME_BURST = 0.3  # of the mean period: samples cannot have been taken that close together
MANY = 0.3  # of all steps: so many short ones are no accident
GRID = 0.02  # of the mean period: what a step may differ from the usual one on a grid
FEW = 1e-3  # of all steps: odd steps of a grid (samples missing)
SEVERAL = 8  # samples: more than a displaced stamp and its neighbours, less than most bursts
RESOLUTIONS_S = tuple(digit * 10.0**-decimals for decimals in range(2, 7) for digit in (5, 2, 1))
LINE = 1024  # stamps through which the clock is a straight line
TAIL = 0.05  # of all stamps, on either side: a few late or repeated ones say nothing of how the others were made
NEIGHBOURS = 32  # bursts on each side that tell a gap (all later ones stay late) from a stall (they catch up)
FEWEST_NEIGHBOURS = 4  # the last burst of a file may be cut off, its newest sample is then none
# Of the usual period. Less cannot be told from the scatter of bursts, and then costs less than it does; exact stamps
# show each missing sample.
LEAST_GAP, LEAST_GAP_ON_GRID = 5.0, 0.5
WHOLE = 0.9  # of a period: on a grid so long a step is a missing sample, with few neighbours as well
SPAN_S = 1.0  # no burst lasts longer: the median period over such spans is that of the samples
SPANS = 4096  # that are looked at
# A longer step in the time is a time in which nothing was recorded, however few samples stand beside it. So much may be
# missing of the longest window (5 % of a minute).
OFF_S = 3.0
LONG_STEPS = 10.0  # times the usual step between bursts, besides: of a slow device that step may be longer than OFF_S
# Two of a kind differ by some per cent; a device whose rate was set anew has another filter as well.
MOST_CHANGE = 0.1
MIDDLE = 0.2, 0.6  # of the steps of a span, from the shortest on: those that count
AROUND, LEAST_OF = 15, 3  # spans, and which of their periods counts: some of them hold a gap, and a few a late burst


BLOCK_ROWS = 1 << 20  # looked at in one go: a quarter of an hour at 1 kHz, bounds memory


@dataclass(frozen=True, slots=True, eq=False)
class Arrivals:
    """What stamps say: the newest sample of each burst (B,) and when it arrived (B,), and how the stamps were made."""

    kind: Kind
    index: IntArray
    arrival_s: Array


def clock_from_stamps(stamp_s: Slices) -> ClockFit:
    """The clock of a device from the stamps (n,) of its consecutive samples, n >= 2.

    Parabolas over a minute each, joined; anew after each gap and every `BLOCK_ROWS` rows. Rate and uncertainties are
    those of the last piece with enough bursts to tell them. Raises ValueError where time does not pass at all.
    """
    edges = np.linspace(0, len(stamp_s), -(-len(stamp_s) // BLOCK_ROWS) + 1).astype(int).tolist()
    pieces: list[ClockFit] = []
    gaps: list[int] = []
    telling = 0
    edge: Edge | None = None
    for first, stop in itertools.pairwise(edges):
        arrivals = arrivals_from_stamps(stamp_s[first:stop])
        period = _usual_period(arrivals)
        found = _gaps(arrivals, period)
        cuts = [0, *np.searchsorted(arrivals.index, found).tolist(), len(arrivals.index)]
        parts = [(arrivals.index[a:b], arrivals.arrival_s[a:b]) for a, b in itertools.pairwise(cuts)]
        edge = edge or _edge(arrivals.kind, *max(parts, key=lambda part: len(part[0])))
        bounds = [0, *found.tolist(), stop - first]
        if first and np.ptp(stamp_s[first - 1 : first + 1]) > OFF_S:
            gaps.append(first)
        for (index, arrival_s), (a, b) in zip(parts, itertools.pairwise(bounds), strict=True):
            telling = len(pieces) if len(index) >= FEWEST_FOR_RATE else telling
            pieces.append(_piece(index + first, arrival_s, first + a, first + b - 1, 1.0 / period, edge))
        gaps += [first + gap for gap in found.tolist()]
    return replace(
        pieces[telling],
        index=pieces[-1].index,
        offset_s=pieces[-1].offset_s,
        knot_index=np.concatenate([p.knot_index for p in pieces]),
        knot_time_s=np.concatenate([p.knot_time_s for p in pieces]),
        knot_period_s=np.concatenate([p.knot_period_s for p in pieces]),
        gaps=np.array(gaps, dtype=np.int64),
    )


def change_of_rate(stamp_s: Slices) -> tuple[int, float, float] | None:
    """The row from which on the rate of stamps (n,) is another one, and the rates (Hz) before and after; None where it
    stays within MOST_CHANGE, or where there are too few rows to tell.

    Only the samples that are there count, so that none that is missing changes a rate.
    """
    size, kind, periods = 0, "", []
    for first in range(0, len(stamp_s), BLOCK_ROWS):
        t = np.asarray(stamp_s[first : first + BLOCK_ROWS], dtype=float)
        if not size:
            size, kind = max(_span(t)[0], 1), kind_of(t)
        whole = (len(t) - 1) // size * size
        if kind == "bursts":
            periods.append(np.diff(t[: whole + 1 : size]) / size)
        else:
            # Not the median: of 400 Hz in stamps of whole ms, steps of 2 and 3 ms take turns in being that. The longest
            # ones are where samples are missing.
            steps = np.sort(np.diff(t[: whole + 1]).reshape(-1, size), axis=1)
            low, high = np.floor(np.multiply(MIDDLE, size)).astype(int)
            periods.append(steps[:, low : max(high, low + 1)].mean(axis=1))
    found = np.concatenate(periods)
    if len(found) < 2 * AROUND:
        return None
    around = np.partition(sliding_window_view(found, AROUND), LEAST_OF, axis=1)[:, LEAST_OF]
    before, after = around[:-AROUND], around[AROUND:]
    logs = np.log(np.maximum([before, after], 1e-12))
    at = int(np.argmax(np.abs(logs[1] - logs[0])))
    if abs(logs[1, at] - logs[0, at]) <= np.log1p(MOST_CHANGE):
        return None
    near = np.log(np.maximum(found[at : at + 2 * AROUND], 1e-12))
    misfit = [np.abs(near[:k] - logs[0, at]).sum() + np.abs(near[k:] - logs[1, at]).sum() for k in range(len(near))]
    return (at + int(np.argmin(misfit))) * size, 1.0 / float(before[at]), 1.0 / float(after[at])


def counted(clock: ClockFit) -> tuple[ClockFit, IntArray, IntArray]:
    """The clock of samples numbered so that missing ones count too, as a device's own count does.

    `clock` numbers the rows of a file (`clock_from_stamps`). Returns the clock without gaps; the rows (P,) at which
    runs without a gap begin, and the number (P,) of the first sample of each run.
    """
    rows = np.concatenate([[0], clock.gaps]).astype(np.int64)
    shift = np.zeros(len(rows), dtype=np.int64)
    for p, row in enumerate(clock.gaps.tolist(), start=1):
        before_s, after_s = clock.time_of([row - 1, row])
        at = int(np.searchsorted(clock.knot_index, row - 0.5))
        periods = float(after_s - before_s) / float(clock.knot_period_s[min(at, len(clock.knot_period_s) - 1)])
        shift[p] = shift[p - 1] + max(round(periods) - 1, 0)
    moved = shift[np.searchsorted(rows, clock.knot_index, side="right") - 1]
    whole = replace(
        clock,
        knot_index=clock.knot_index + moved,
        index=clock.index + int(shift[-1]),
        gaps=np.empty(0, dtype=np.int64),
    )
    return whole, rows, rows + shift


def arrivals_from_stamps(stamp_s: Array) -> Arrivals:
    """Bursts out of stamps (n,): equal or close ones are one, so are those spread at a nominal rate; else each is."""
    t = np.asarray(stamp_s, dtype=float)
    kind, breaks = _classified(t)
    index = np.append(np.flatnonzero(breaks), len(t) - 1)
    return Arrivals(kind, index, t[index])


def kind_of(stamp_s: Array) -> Kind:
    """How the stamps (n,) were made. Raises ValueError where time does not pass at all."""
    return _classified(np.asarray(stamp_s, dtype=float))[0]


def _classified(t: Array) -> tuple[Kind, NDArray[np.bool_]]:
    """The kind of stamps, and after which of them (n - 1,) a burst ends."""
    steps = np.diff(t)
    if not (len(steps) and t[-1] > t[0]):
        raise ValueError(f"time must pass between the first stamp and the last, from {t[0]} s to {t[-1]} s")
    period = _period(t)
    short = steps < SAME_BURST * period
    usual = float(np.median(steps))
    if np.mean(short) >= MANY and usual < SAME_BURST * period:
        return "bursts", ~short
    tolerance = max(GRID * usual, 1.5 * _resolution(t))
    odd = np.abs(steps - usual) > tolerance
    missing = odd & _misses(steps, odd, usual, tolerance)
    each = np.ones(len(steps), dtype=bool)
    told = odd & ~missing
    if np.mean(told) < FEW or np.count_nonzero(told) < 2:
        return "grid", each
    if _last(t, float(np.mean(odd)), GRID * usual, missing):
        return "spread", odd
    return ("grid" if _evenly(t, usual) else "jittery"), each


def _period(t: Array) -> float:
    """The mean period of stamps t (n,), n >= 2, while they were recorded: times in which nothing was recorded do not
    move it, however long they are. Of a short file it is the plain mean."""
    size, span = _span(t)
    return span / size if size else float(t[-1] - t[0]) / (len(t) - 1)


def _span(t: Array) -> tuple[int, float]:
    """After how many samples SPAN_S or more have usually passed, and how long that takes; 0, 0.0 in a short file."""
    size = 1
    while 2 * size < len(t):
        at = np.linspace(0, len(t) - 1 - size, min(SPANS, len(t) - size)).astype(np.int64)
        span = float(np.median(t[at + size] - t[at]))
        if span >= SPAN_S:
            return size, span
        size *= 2
    return 0, 0.0


def _misses(steps: Array, odd: NDArray[np.bool_], usual: float, tolerance: float) -> NDArray[np.bool_]:
    """Which steps are a whole number of the usual one, or longer than it by LEAST_GAP: samples are missing there, which
    says nothing of how stamps are made. `odd`: which differ from the usual one."""
    exact = float(np.mean(steps[~odd])) if not odd.all() else usual
    return np.asarray((np.abs(steps - np.round(steps / exact) * exact) <= tolerance) & (steps > 1.5 * usual)) | (
        steps > (1.0 + LEAST_GAP) * usual
    )


def _last(t: Array, odd: float, least: float, missing: NDArray[np.bool_]) -> bool:
    """Whether steps that differ by `least` from the usual one shift all later stamps too, as the ends of bursts do.

    `odd` is the share of such steps. A stamp that is displaced alone, by rounding or jitter, makes no more of them over
    several samples than over one. Where samples are `missing` (n - 1,), nothing is looked at.
    """
    if odd >= 0.5:
        return False
    before = np.append(0, np.cumsum(missing))
    over = (t[SEVERAL:] - t[:-SEVERAL])[before[SEVERAL:] == before[:-SEVERAL]]
    return len(over) == 0 or bool(np.mean(np.abs(over - np.median(over)) > least) > 2.0 * odd)


def _evenly(t: Array, period: float) -> bool:
    """Whether stamps scatter equally far to both sides, within a period in all: rounded ones do, late ones do not.

    Each stretch of `LINE` stamps has a straight line of its own; one in which nothing was recorded for a time has none.
    """
    size = min(len(t), LINE)
    y = (t[: len(t) // size * size] - t[0]).reshape(-1, size)
    lasts = y[:, -1] - y[:, 0]
    y = y[lasts < np.median(lasts) + OFF_S]
    x = np.arange(size) - 0.5 * (size - 1)
    rest = y - y.mean(axis=1, keepdims=True) - np.outer(y @ x / (x @ x), x)
    low, middle, high = np.quantile(rest, [TAIL, 0.5, 1.0 - TAIL])
    return bool(high - low <= period and high - middle <= 2.0 * (middle - low) + GRID * period)


def _resolution(t: Array) -> float:
    """The step the stamps are rounded to, one, two or five of a decimal; 0 where finer than a microsecond."""
    some = t[:4096] - t[0]
    rounding = max(1e-9, 2.0 * float(np.spacing(np.abs(t[:4096]).max())))  # of a time since 1970 it is half a us
    for step in RESOLUTIONS_S:
        if np.abs(some - np.round(some / step) * step).max() < rounding:
            return step
    return 0.0


def _edge(kind: Kind, index: IntArray, arrival_s: Array) -> Edge:
    """Exact or symmetrically scattering stamps stand for the sample itself; all others come after it.

    Scatter is symmetrical where its lower tail is at least half as long as its upper one.
    """
    if kind != "jittery":
        return "mean" if kind == "grid" else "early"
    x, y = (index - index[0])[:20_000], (arrival_s - arrival_s[0])[:20_000]
    low, middle, high = np.quantile(y - np.polyval(np.polyfit(x, y, 1), x), [0.02, 0.5, 0.98])
    return "mean" if middle - low > 0.5 * (high - middle) else "early"


def _usual_period(arrivals: Arrivals) -> float:
    """Median of the mean periods over neighbouring bursts: gaps do not move it, and times in which nothing was recorded
    do not count."""
    span = min(NEIGHBOURS, len(arrivals.index) - 1)
    index, arrival_s = arrivals.index, arrivals.arrival_s
    steps, samples = np.diff(arrival_s), np.diff(index)
    off = steps > max(OFF_S, LONG_STEPS * float(np.median(steps)))
    if off.any():
        more_s = np.where(off, steps - samples * float(np.median(steps / samples)), 0.0)
        arrival_s = arrival_s - np.append(0.0, np.cumsum(more_s))
    return float(np.median((arrival_s[span:] - arrival_s[:-span]) / (index[span:] - index[:-span])))


def _gaps(arrivals: Arrivals, period: float) -> IntArray:
    """Sample numbers before which samples are missing: all bursts from there on are later than those before."""
    late = arrivals.arrival_s - period * arrivals.index
    on_grid = arrivals.kind == "grid"
    least = period * (LEAST_GAP_ON_GRID if on_grid else LEAST_GAP)
    sure = WHOLE * period if on_grid else OFF_S
    steps = np.diff(late)
    found = [0, len(late)]
    # The largest first: a stall just before a gap would else be taken for it.
    for b in sorted((np.flatnonzero(steps > least) + 1).tolist(), key=lambda b: -steps[b - 1]):
        right = bisect.bisect(found, b)
        before = late[max(found[right - 1], b - NEIGHBOURS) : b]
        after = late[b : min(found[right], b + NEIGHBOURS)]
        if min(len(before), len(after)) < FEWEST_NEIGHBOURS and steps[b - 1] < sure:
            continue
        if min(after.min() - before.min(), np.median(after) - np.median(before)) > least:
            found.insert(right, b)
    return arrivals.index[np.array(found[1:-1], dtype=np.int64) - 1] + 1


def _piece(index: IntArray, arrival_s: Array, first: int, last: int, nominal_hz: float, edge: Edge) -> ClockFit:
    """Samples `first` to `last` without a gap: a parabola over each minute, knots half a minute apart."""
    begin, end = float(arrival_s[0]), float(arrival_s[-1])
    if end - begin <= HORIZON_S:
        return parabola(index, arrival_s, nominal_hz, edge).clock(first, last)
    knots = min(2.0 * (end - begin) / HORIZON_S, len(index))  # more than there are bursts would tell nothing new
    centres = np.linspace(begin, end, max(3, round(knots) + 1))[1:-1]
    fits = []
    for centre in centres:
        a, b = np.searchsorted(arrival_s, [centre - HORIZON_S / 2, centre + HORIZON_S / 2])
        if b - a < FEWEST_FOR_RATE:  # bursts are rare: those around the centre, however far
            a = max(int(np.searchsorted(arrival_s, centre)) - FEWEST_FOR_RATE // 2, 0)
            b = a + FEWEST_FOR_RATE
        fits.append(parabola(index[a:b], arrival_s[a:b], nominal_hz, edge))
    at_index = np.array([first, *np.interp(centres, arrival_s, index), last], dtype=float)
    at = [fits[0], *fits, fits[-1]]
    return replace(
        fits[-1].clock(first, last),
        knot_index=at_index,
        knot_time_s=np.array([float(f.at(k)) for f, k in zip(at, at_index, strict=True)]),
        knot_period_s=np.array([float(f.period_at(k)) for f, k in zip(at, at_index, strict=True)]),
    )
