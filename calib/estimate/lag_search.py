"""Iterative search for the lag: make windows, estimate their remaining lag, remove it, and make the windows again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np

from calib.model import Array, Window

TURNS = 4  # each iteration leaves about a thousandth of the lag
BASIN_RAD = 0.5  # of the motion's mean phase: from a start that is so near, the iterations lead to the lag
# Limit of (omega lag)^3 / 6, the error of the window equations, which are of second order in the remaining lag.
PHASE_LEFT = 1e-8
AS_HIGH = 0.9  # of the highest peak of a correlation: peaks of motion with one frequency differ by less
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


def starts(low_s: float, high_s: float, windows: Sequence[Window]) -> list[float]:
    """Lags in s from `low_s` to `high_s`, so dense that one of them is near enough to every lag between (BASIN_RAD).

    The `windows`, used or not, tell how fast the motion is. `without_lag` leads from the best of them to the lag.
    """
    count = int(np.ceil((high_s - low_s) * max(largest_omega(windows), np.finfo(float).tiny) / (2.0 * BASIN_RAD)))
    edges = np.linspace(low_s, high_s, max(count, 1) + 1)
    return [float(lag_s) for lag_s in 0.5 * (edges[:-1] + edges[1:])]


def largest_omega(windows: Sequence[Window]) -> float:
    """Largest mean angular frequency (rad/s) of any window: the rms of du/dt over that of u; 0 at rest."""
    largest = 0.0
    for window in windows:
        m, power = window.sums.reference_channels, np.diag(window.sums.scatter.sum(axis=0))
        if m and power[:m].sum() > 0.0:
            largest = max(largest, float(np.sqrt(power[m : 2 * m].sum() / power[:m].sum())))
    return largest


def correlated_lag_s(parts: Iterable[tuple[Array, Array]], rate_hz: float, furthest_s: float) -> float | None:
    """The lag in s at which the outputs V follow the reference u best, from their cross-correlation.

    `parts` are stretches of evenly spaced samples: V (n, 3) and u (n, m). Lags up to `furthest_s` to both sides are
    compared. Where several peaks are almost equally high, as in motion of one frequency, the one nearest to 0 counts.
    None if there is no motion. The lag is right to about a sample; `without_lag` leads from there to the lag.
    """
    size = int(np.ceil(furthest_s * rate_hz))
    correlation = np.zeros(2 * size + 1)
    for V, u in parts:
        length = 1 << (len(V) + size).bit_length()
        out, moved = (np.fft.rfft(x - x.mean(axis=0), length, axis=0) for x in (V, u))
        power = np.outer(*(np.var(x, axis=0) * len(x) for x in (V, u)))
        both = np.fft.irfft(out[:, :, None] * moved[:, None, :].conj(), length, axis=0)
        both = np.concatenate([both[length - size :], both[: size + 1]])
        correlation += np.sum(np.divide(both**2, power, out=np.zeros_like(both), where=power > 0.0), axis=(1, 2))
    around = np.concatenate([[-np.inf], correlation, [-np.inf]])
    peaks = np.flatnonzero((correlation >= around[:-2]) & (correlation >= around[2:]))
    high = peaks[correlation[peaks] >= AS_HIGH * correlation.max()]
    if not correlation.max() > 0.0:
        return None
    return float((high[np.argmin(np.abs(high - size))] - size) / rate_hz)
