"""Detection of rests in the indications of a sensor that is put down repeatedly; no reference is needed."""

from __future__ import annotations

import numpy as np

from calib.model import Array
from calib.signal.order_statistics import quantile

BLOCK_S = 0.25  # long enough to distinguish noise from a rotation, short compared with a rest
LEAST_REST_S = 1.0
GUARD_S = 0.25  # left out at both ends of a rest, where hands release and take the sensor
# The method needs a sensor that rests during at least a quarter of the blocks: this quantile then shows the noise.
STILL_QUANTILE = 0.25
# Limit for a block at rest, relative to that noise: noise alone exceeds it in 3e-5 of the blocks; a rotation of 1 deg/s
# always exceeds it.
STILL_FACTOR = 4.0
# The quantile of a dozen steps is uncertain. So a step is also accepted up to this factor times the SD of a step of
# white noise, which white noise exceeds in 3e-4 of the blocks.
WHITE_FACTOR = 2.6


def find_rests(V: Array, rate_hz: float) -> list[tuple[int, int]]:
    """Rests in indications V (n, 3) at `rate_hz`: [first, stop) sample numbers, in order.

    A block of 0.25 s is at rest if its SD, and the differences between its mean and the means of both neighbours, are
    not larger than noise explains.
    """
    size = max(round(BLOCK_S * rate_hz), 2)
    blocks = len(V) // size
    if blocks < 3:
        return []
    shaped = V[: blocks * size].reshape(blocks, size, 3)
    sd = np.sqrt(shaped.var(axis=1).sum(axis=1))
    step = np.linalg.norm(np.diff(shaped.mean(axis=1), axis=0), axis=1)
    noise = quantile(sd, STILL_QUANTILE)
    calm = sd <= STILL_FACTOR / 2.0 * noise
    near = step <= max(STILL_FACTOR * quantile(step, STILL_QUANTILE), WHITE_FACTOR * noise * np.sqrt(2.0 / size))
    still = calm & np.concatenate([[True], near]) & np.concatenate([near, [True]])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    guard = round(GUARD_S * rate_hz)
    runs = [(int(a) * size + guard, int(b) * size - guard) for a, b in edges.reshape(-1, 2)]
    return [(a, b) for a, b in runs if b - a >= LEAST_REST_S * rate_hz]
