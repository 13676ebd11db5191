"""Single samples of a reference that no motion made: a spike, or a step between two samples.

A reference's error of one sample has more weight in a regression than thousands of sound samples, and a step of a
velocity is a spike of its derivative. Motion that a sampled instrument can follow changes its curvature over several
samples; a spike or a step stands alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.signal.order_statistics import median

# Curvature over the usual curvature nearby. Gaussian motion with noise reaches 7 in 3.6 million samples.
LIMIT = 50.0
LIMIT_STEPS = 8.0  # times the resolution of the samples, below which a curvature may be rounding
BLOCK = 64  # samples in which the usual curvature is the median
SAME = 0.75  # of the largest curvature: a spike has 1/2, 1, 1/2 of it, a step 1 and 1
BESIDE, CALM = 8, 0.1  # so many samples on each side have less than this share of the curvature: it stands alone
MOST = 0.01  # of the samples; what is more frequent is no glitch

Mask = NDArray[np.bool_]


def glitches(x: Array) -> Mask:
    """Which rows (n,) of x (n, k) hold a spike or are beside a step. Rows with NaN are missing samples."""
    found = np.zeros(len(x), dtype=bool)
    if len(x) < 2 * BLOCK:
        return found
    for channel in x.T:
        found |= _of_channel(np.ascontiguousarray(channel))
    return found if found.mean() <= MOST else np.zeros(len(x), dtype=bool)


def _of_channel(x: Array) -> Mask:
    found = np.zeros(len(x), dtype=bool)
    bend = np.zeros(len(x))
    bend[1:-1] = np.abs(np.nan_to_num(np.diff(x, n=2)))
    high = np.flatnonzero(bend > LIMIT * np.maximum(_usual(bend), np.finfo(float).tiny))
    if not len(high) or len(high) > 3 * MOST * len(x):
        return found
    steps = np.abs(np.diff(x))
    high = high[bend[high] > LIMIT_STEPS * float(np.min(steps, where=steps > 0.0, initial=np.inf))]
    for group in np.split(high, np.flatnonzero(np.diff(high) > 1) + 1):
        if not len(group):
            continue
        peak = float(bend[group].max())
        worst = group[bend[group] >= SAME * peak]
        first, last = int(worst[0]), int(worst[-1])
        around = np.concatenate([bend[max(first - BESIDE, 0) : max(first - 1, 0)], bend[last + 2 : last + 1 + BESIDE]])
        if last - first <= 1 and np.all(around < CALM * peak):
            found[first : last + 1] = True
    return found


def _usual(bend: Array) -> Array:
    """(n,) the median curvature of the block of each sample or of a neighbouring block, whichever is largest."""
    blocks = len(bend) // BLOCK
    medians = median(bend[: blocks * BLOCK].reshape(blocks, BLOCK))
    padded = np.concatenate([medians[:1], medians, medians[-1:]])
    largest = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    return np.repeat(np.append(largest, largest[-1]), BLOCK)[: len(bend)]
