"""Iterative search for the lag: make windows, estimate their remaining lag, remove it, and make the windows again."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from calib.model import Array, Window
from calib.signal.order_statistics import median

TURNS = 4  # each iteration leaves about a thousandth of the lag
BASIN_RAD = 0.5  # of the motion's mean phase: from a start that is so near, the iterations lead to the lag
# Limit of (omega lag)^3 / 6, the error of window equations of second order in the remaining lag. Of those of first
# order (calib.estimate.physics, within what the clocks leave open) the error is then 8e-6.
PHASE_LEFT = 1e-8
SLOWEST = 0.25  # of the mean frequency of the motion: slower motion does not count in a correlation
AS_HIGH = 0.9  # of the highest peak of a correlation: peaks of motion with one frequency differ by less
HARDLY = 0.99  # of a correlation: with noise, the best rate of clocks in step is not exactly 0
FINER = 4  # lags a sample: the fastest motion that resampling keeps turns by half a rad from one to the next
SEGMENT_S = 2.0  # of samples that have one lag: a few cycles of the motion
PIECE_S = 20.0  # of samples that are correlated at once: clocks that differ by 200 ppm change their lag by 4 ms
MOST_PIECES, MOST_RATES = 200, 500  # of a recording, that of a day too
IntArray = NDArray[np.int64]
Made = TypeVar("Made")


def without_lag(
    lag_s: float,
    make: Callable[[float], Made],
    used: Callable[[Made], Sequence[Window]],
    lag_of: Callable[[Made, float], float],
) -> tuple[Made, float]:
    """Windows whose remaining lag is negligible, and the lag in s that was removed from them.

    `make(lag_s)` makes windows from which this lag is removed; `used(made)` gives those of them that are used;
    `lag_of(made, lag_s)` estimates the whole lag from them, in s. The search begins at `lag_s`. It ends when the
    remaining lag is small enough, after TURNS iterations, or when no window is used.
    """
    turns = 0
    while True:
        made = make(lag_s)
        windows = used(made)
        turns += 1
        if not windows or turns == TURNS:
            return made, lag_s
        better_s = lag_of(made, lag_s)
        if abs(largest_omega(windows) * (better_s - lag_s)) ** 3 / 6.0 <= PHASE_LEFT:
            return made, lag_s
        lag_s = better_s
        del made, windows  # of a day, they would need as much memory as those that follow


def misfit_by_lag(
    V: Array, expected: Array, sample: IntArray, rate_hz: float, furthest_s: float
) -> tuple[Array, Array]:
    """How badly outputs fit what was expected of them, had they come later by each of L lags (L,) in s, which rise.

    V (n, 3) and `expected` (n, 3) are at the same times, the numbers (n,) of their samples at `rate_hz` rise. The lags
    reach as far as `furthest_s` to both sides, but leave half of the time. The misfit (L,) is the mean square of what
    is left, over the least of it, times the 3 n values: of white noise it rises by 1 one standard uncertainty away.
    All lags follow from the same spectra.
    """
    n = int(sample[-1] - sample[0]) + 1
    size = min(int(np.ceil(furthest_s * rate_hz)), n // 2)
    length = 1 << (n + size).bit_length()
    rows = np.zeros((9, n))
    at = sample - sample[0]
    rows[0, at] = 1.0
    rows[1:4, at], rows[4:7, at] = (x.T - x.mean(axis=0)[:, None] for x in (V, expected))
    rows[7], rows[8] = np.sum(rows[1:4] ** 2, axis=0), np.sum(rows[4:7] ** 2, axis=0)
    there, out, moved, square, moved_square = np.split(np.fft.rfft(rows, length, axis=1), [1, 4, 7, 8])
    left = square * there.conj() + there * moved_square.conj() - 2.0 * np.sum(out * moved.conj(), axis=0)
    both = np.fft.irfft(np.vstack([left, there * there.conj()]), FINER * length, axis=1)
    k = np.arange(-FINER * size, FINER * size + 1)
    mean_square = both[0, k] / both[1, k]
    least = max(float(mean_square.min()), np.finfo(float).eps * float(mean_square.max()), np.finfo(float).tiny)
    return k / (FINER * rate_hz), 3.0 * len(V) * mean_square / least


def longest_in_time(
    V: Array, expected: Array, time_s: Array, furthest_s: float, least_fall: float
) -> tuple[float, float] | None:
    """The longest stretch of outputs V (n, 3) that come when they are expected (n, 3), from one time in s to another;
    None where all do, or none does.

    Stretches of SEGMENT_S are looked at one by one. One of them comes at another lag, up to `furthest_s`, if it fits
    half as badly there and the misfit (see `misfit_by_lag`) falls by `least_fall`. A sensitivity that changes, a knock
    or noise do not look so. Beside a stretch at another lag, one more is left out: the lag may change within it.
    """
    rate_hz = 1.0 / float(median(np.diff(time_s)))
    sample = np.rint((time_s - time_s[0]) * rate_hz).astype(np.int64)
    edges = np.arange(0.0, max(time_s[-1] - time_s[0] - 0.5 * SEGMENT_S, SEGMENT_S), SEGMENT_S)
    cuts = [*np.searchsorted(time_s, time_s[0] + edges).tolist(), len(time_s)]
    off = np.zeros(len(cuts) - 1, dtype=bool)
    for k, (a, b) in enumerate(itertools.pairwise(cuts)):
        if b - a >= 0.5 * SEGMENT_S * rate_hz:
            _, misfit = misfit_by_lag(V[a:b], expected[a:b], sample[a:b], rate_hz, furthest_s)
            here, least = float(misfit[len(misfit) // 2]), float(misfit.min())
            off[k] = least < 0.5 * here and here - least > least_fall
    left = off | np.append(off[1:], False) | np.append(False, off[:-1])
    if not off.any() or left.all():
        return None
    ends = np.flatnonzero(np.diff(left, prepend=True, append=True)).reshape(-1, 2)
    first, stop = ends[np.argmax(ends[:, 1] - ends[:, 0])].tolist()
    return float(time_s[cuts[first]]), float(time_s[cuts[stop] - 1])


def minima(lags_s: Array, misfit: Array) -> tuple[Array, Array]:
    """The lags (M,) in s and the values (M,) of the minima of a misfit (L,) at evenly spaced lags (L,), the deepest
    first: those of the parabola through the lowest lag and its two neighbours."""
    before, here, after = misfit[:-2], misfit[1:-1], misfit[2:]
    k = np.flatnonzero((here < before) & (here <= after))
    slope, bend = 0.5 * (after[k] - before[k]), after[k] - 2.0 * here[k] + before[k]
    at_s, depth = lags_s[k + 1] - slope / bend * (lags_s[1] - lags_s[0]), here[k] - 0.5 * slope**2 / bend
    order = np.argsort(depth, kind="stable")
    return at_s[order], depth[order]


def largest_omega(windows: Sequence[Window]) -> float:
    """Largest mean angular frequency (rad/s) of any window: the rms of du/dt over that of u; 0 at rest."""
    largest = 0.0
    for window in windows:
        m, power = window.sums.reference_channels, np.diag(window.sums.scatter.sum(axis=0))
        if m and power[:m].sum() > 0.0:
            largest = max(largest, float(np.sqrt(power[m : 2 * m].sum() / power[:m].sum())))
    return largest


def correlated_lag(
    parts: Iterable[tuple[Array, Array, Array]], span_s: float, furthest_s: float, most_rate: float, omega: float
) -> tuple[float, float, float] | None:
    """The lag in s at which the outputs V follow the reference u best, by their cross-correlation; by how much it
    changes in a second, where the two clocks run apart; and the time in s at which it is this lag.

    `parts` are stretches of evenly spaced samples within `span_s`: times (n,) in s, V (n, 3) and u (n, m). They are
    taken one by one, so that those of a day need not be held. Lags up to `furthest_s` to both sides and changes up to
    `most_rate` are compared; `omega` is the angular frequency of the motion in rad/s.
    Where several peaks are almost equally high, as in motion of one frequency, that of the slowest change counts, and
    of these the one nearest to 0. None if there is no motion. The lag is right to a sample over FINER, or to an eighth
    of a period at both ends of the parts where the clocks run apart; `without_lag` leads from there to the lag.
    """
    every, reach_s = max(1, int(np.ceil(span_s / (PIECE_S * MOST_PIECES)))), furthest_s + 0.5 * most_rate * span_s
    step_s, middles, correlations = 0.0, [], []
    for time_s, V, u in islice((piece for part in parts for piece in _pieces(*part)), 0, None, every):
        step_s = step_s or float(median(np.diff(time_s))) / FINER
        middles.append(0.5 * (time_s[0] + time_s[-1]))
        slowest = SLOWEST * omega / (2.0 * np.pi) * FINER * step_s
        correlations.append(_correlation(V, u, int(np.ceil(reach_s / step_s)) + 1, slowest))
    if not middles:
        return None
    middles_s = np.array(middles)
    at_s, half_s = 0.5 * float(middles_s[0] + middles_s[-1]), 0.5 * float(np.ptp(middles_s))
    finest = max(step_s, np.pi / 4.0 / omega) / half_s if half_s else np.inf
    number = int(min(np.ceil(most_rate / finest), MOST_RATES))
    rates = np.linspace(-most_rate, most_rate, 2 * number + 1) if number else np.zeros(1)
    shifts = np.rint(np.outer(rates, middles_s - at_s) / step_s).astype(int)
    size = int(np.ceil(furthest_s / step_s))
    total = np.zeros((len(rates), 2 * size + 1))
    for correlation, own in zip(correlations, shifts.T, strict=True):
        for row, first in zip(total, (own + len(correlation) // 2 - size).tolist(), strict=True):
            row += correlation[first : first + 2 * size + 1]
    return _slowest_peak(total, rates, step_s, at_s)


def _pieces(time_s: Array, V: Array, u: Array) -> Iterable[tuple[Array, Array, Array]]:
    """Pieces of PIECE_S of a stretch: clocks that run apart change the lag within longer ones."""
    number = max(1, round(float(time_s[-1] - time_s[0]) / PIECE_S))
    return zip(*(np.array_split(x, number) for x in (time_s, V, u)), strict=True)


def _correlation(V: Array, u: Array, size: int, slowest: float) -> Array:
    """The squared correlation (2 size + 1,) of outputs and reference, at lags of -size to size steps of a sample over
    FINER: between two samples the peak of fast motion would be too low. What has less than `slowest` cycles a sample is
    left out: beside turns against gravity, which are slow and large, all lags of the motion would look alike."""
    length = 1 << (len(V) + size // FINER).bit_length()
    out, moved = (np.fft.rfft(x - x.mean(axis=0), length, axis=0) for x in (V, u))
    slow = int(np.ceil(slowest * length))
    out[:slow], moved[:slow] = 0.0, 0.0
    power = np.outer(*(2.0 * np.sum(np.abs(x) ** 2, axis=0) / length for x in (out, moved)))
    both = FINER * np.fft.irfft(out[:, :, None] * moved[:, None, :].conj(), FINER * length, axis=0)
    both = np.concatenate([both[-size:], both[: size + 1]])
    return np.asarray(np.divide(both**2, power, out=np.zeros_like(both), where=power > 0.0).sum(axis=(1, 2)) * len(V))


def _slowest_peak(total: Array, rates: Array, step_s: float, at_s: float) -> tuple[float, float, float] | None:
    """The peak of correlations (R, 2 size + 1), at these rates and at lags around 0, that counts."""
    if not total.max() > 0.0:
        return None
    around = np.pad(total, 1, constant_values=-np.inf)
    along = np.maximum(around[1:-1, :-2], around[1:-1, 2:])
    across = np.maximum(around[:-2], around[2:])
    across = np.maximum(np.maximum(across[:, :-2], across[:, 2:]), across[:, 1:-1])
    across[len(rates) // 2] *= HARDLY  # clocks do not run apart where that would be hardly better
    peaks = np.argwhere((total >= AS_HIGH * total.max()) & (total >= along) & (total >= across))
    lags = peaks[:, 1] - total.shape[1] // 2
    first = np.lexsort([np.abs(lags), np.abs(rates[peaks[:, 0]])])[0]
    return float(lags[first] * step_s), float(rates[peaks[first, 0]]), at_s
