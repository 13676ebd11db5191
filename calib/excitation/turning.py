"""Where a sensor and a DC-coupled tri-axial reference stand still against gravity, and where both are turned."""

from __future__ import annotations

import numpy as np

from calib.excitation.standing import MEAN_S, Standing
from calib.model import Array

GUARD_S = 1.0  # left out at both ends of a turn: hands that come and go, and what the search does not resolve
LEAST_GRAVITY_MPS2 = 5.0  # of a mean input acceleration: a reference that shows less does not feel gravity


def feels_gravity(u: Array) -> bool:
    """Whether a tri-axial reference u (n, 3) in m/s2 shows gravity in its mean."""
    return len(u) > 0 and float(np.linalg.norm(u, axis=1).mean()) > LEAST_GRAVITY_MPS2


def is_turned(u: Array, rate_hz: float) -> bool:
    """Whether a reference u (n, m) in m/s2 feels gravity and is turned."""
    return u.shape[1] == 3 and feels_gravity(u) and standing_parts(u, rate_hz) != [(0, len(u))]


def standing_parts(u: Array, rate_hz: float) -> list[tuple[int, int]]:
    """[first, stop) of the samples u (n, 3), in m/s2, between which nothing was turned, GUARD_S off each turn.

    Empty where it is turned throughout.
    """
    size, guard = max(round(MEAN_S * rate_hz), 1), round(GUARD_S * rate_hz)
    means = u[: len(u) // size * size].reshape(-1, size, 3).mean(axis=1)
    standing, parts, first = Standing(), list[tuple[int, int]](), None
    for mean in means:
        end = standing.update(mean)
        if end is not None and first is not None:
            parts.append((first * size, end * size - guard))
        first = standing.first
    if first is not None:
        parts.append((first * size, len(u)))
    return [(a + guard if a else 0, b) for a, b in parts if b > a + guard]
