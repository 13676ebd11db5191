"""Whether S was the same in both halves of a recording: a gain that changes within it leaves a mean that is neither."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.adjustment.adjustment import Adjustment, adjust
from calib.estimate.axes import AXES
from calib.model import Array, Window

FEWEST = 2  # windows in motion in each half
SURELY = 5.0  # standard uncertainties of the difference


@dataclass(frozen=True, slots=True, eq=False)
class ChangeWithin:
    """What a user is told of it, and half of the change of each element of S (9,), 0 where a half tells none."""

    words: str
    half: Array


def change_within(found: Adjustment) -> ChangeWithin | None:
    """By how much S differs between the first and the second half of the time; None where that may be chance, or where
    a half tells too little.

    The standard uncertainty of the difference is that of both, as if they had nothing in common. So a change is told
    that moves S in each half by some 3 u from the result.
    """
    windows = sorted(found.grounds.windows, key=lambda window: window.start_s)
    twice_middle_s = windows[0].start_s + windows[-1].stop_s
    halves = [[w for w in windows if (w.start_s + w.stop_s < twice_middle_s) == early] for early in (True, False)]
    if min(map(_moving, halves)) < FEWEST:
        return None
    first, second = (adjust(half, found.grounds.priors, found.grounds.applied).calibration for half in halves)
    both = (found.calibration.determined & first.determined & second.determined)[:9]
    change = np.where(both, (second.sensitivity - first.sensitivity).ravel(), 0.0)
    u = np.sqrt(np.diag(first.covariance + second.covariance)[:9])
    ratio = np.abs(np.divide(change, u, out=np.zeros(9), where=both & (u > 0.0)))
    worst = int(np.argmax(ratio))
    if ratio[worst] <= SURELY:
        return None
    row, column = divmod(worst, 3)
    name, main = f"S{AXES[row]}{AXES[column]}", f"S{AXES[row]}{AXES[row]}"
    share = 100.0 * abs(change[worst]) / max(abs(float(found.mean[4 * row])), np.finfo(float).tiny)
    return ChangeWithin(
        f"S changed within the recording: {name} is {first.sensitivity[row, column]:.5g} in the first half of the time "
        f"and {second.sensitivity[row, column]:.5g} in the second; they are {share:.2g} % of {main}, or "
        f"{ratio[worst]:.0f} standard uncertainties, apart. U covers both. Look for a blow, another range, a loose "
        "mount or warming up, and calibrate the parts by themselves",
        0.5 * change,
    )


def _moving(windows: Sequence[Window]) -> int:
    return sum(window.kind == "motion" for window in windows)
