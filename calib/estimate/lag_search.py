"""The one search for the lag: windows are made, what lag they still have is found, taken out, looked for again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from calib.model import Window

TURNS = 4  # each turn leaves a thousandth of the lag
# Of a lag that windows still have: (omega lag)^3 / 6 is what the equations' own second order leaves of it.
PHASE_LEFT = 1e-8
Made = TypeVar("Made")


def without_lag(
    lag_s: float,
    make: Callable[[float], Made],
    used: Callable[[Made], Sequence[Window]],
    lag_of: Callable[[Made, float], float],
) -> tuple[Made, float]:
    """Windows in which no lag is left that matters, and the lag that was taken out of them, in s.

    `make(lag_s)` makes windows with a lag taken out; `used` gives those of them that are used; `lag_of(made, lag_s)`
    estimates the whole lag from them. The search begins at `lag_s` and ends where no window is used.
    """
    for turn in range(TURNS):
        made = make(lag_s)
        windows = used(made)
        if not windows or turn == TURNS - 1:
            break
        better_s = lag_of(made, lag_s)
        if abs(largest_omega(windows) * (better_s - lag_s)) ** 3 / 6.0 <= PHASE_LEFT:
            break
        lag_s = better_s
    return made, lag_s


def largest_omega(windows: Sequence[Window]) -> float:
    """Largest angular frequency (rad/s) that any window's power stands for; 0 at rest."""
    largest = 0.0
    for window in windows:
        m, power = window.sums.reference_channels, np.diag(window.sums.scatter.sum(axis=0))
        if m and power[:m].sum() > 0.0:
            largest = max(largest, float(np.sqrt(power[m : 2 * m].sum() / power[:m].sum())))
    return largest
