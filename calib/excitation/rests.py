"""Rests of a sensor that was put down again and again: found from its own indications, with no reference at all."""

from __future__ import annotations

import numpy as np

from calib.model import Array

BLOCK_S = 0.25  # long enough to tell noise from turning, short against a rest
LEAST_REST_S = 1.0
GUARD_S = 0.25  # left out at both ends: hands leaving and taking the sensor
# A quarter of the blocks at the least are still (else nothing is found), so this quantile of what blocks do is noise.
STILL_QUANTILE = 0.25
# Times that noise which a still block may show: noise alone passes 4 in 3e-5 of the blocks, a turn of 1 deg/s does not.
STILL_FACTOR = 4.0
# The quantile of a dozen steps is poorly known; steps as white noise makes them (times this, passed by 3e-4) are still.
WHITE_FACTOR = 2.6


def find_rests(V: Array, rate_hz: float) -> list[tuple[int, int]]:
    """Rests in indications V (n, 3) at `rate_hz`: [first, stop) sample numbers, in order.

    A block is still where its SD and the step of its mean from both neighbours are those of the noise.
    """
    size = max(round(BLOCK_S * rate_hz), 2)
    blocks = len(V) // size
    if blocks < 3:
        return []
    shaped = V[: blocks * size].reshape(blocks, size, 3)
    sd = np.sqrt(shaped.var(axis=1).sum(axis=1))
    step = np.linalg.norm(np.diff(shaped.mean(axis=1), axis=0), axis=1)
    noise = np.quantile(sd, STILL_QUANTILE)
    calm = sd <= STILL_FACTOR / 2.0 * noise
    near = step <= max(STILL_FACTOR * np.quantile(step, STILL_QUANTILE), WHITE_FACTOR * noise * np.sqrt(2.0 / size))
    still = calm & np.concatenate([[True], near]) & np.concatenate([near, [True]])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    guard = round(GUARD_S * rate_hz)
    runs = [(int(a) * size + guard, int(b) * size - guard) for a, b in edges.reshape(-1, 2)]
    return [(a, b) for a, b in runs if b - a >= LEAST_REST_S * rate_hz]
