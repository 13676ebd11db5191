"""What a first-order high-pass filter (an AC-coupled instrument) took out of a recording, put back in.

With the corner c in rad/s, the filter's inverse is exact: true = x + c * integral of x. A corner of 0.16 Hz costs
0.56 % between 0.5 and 8 Hz and is no lag: it leads, and less at higher frequencies. Where a corner is to be found from
the data, the integral of what was recorded (not of what a correction made of it) goes into the windows as channels
of its own behind the reference's: the equation stays exact, whatever was taken out before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.model import Array, Pose


def integral(x: Array, rate_hz: float) -> Array:
    """2 pi times the integral of samples x (n, m) in m/s2 s: as large as x itself at 1 Hz.

    Each run of samples without a hole has an integral of its own, NaN in the holes: its constant is lost in the
    window's own. It is held to no mean and no trend: an instrument's own zero would else run away in it.
    """
    out = np.full(x.shape, np.nan)
    whole = np.isfinite(x).all(axis=1)
    edges = np.flatnonzero(np.diff(whole.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    for first, stop in edges.tolist():
        out[first:stop] = _integral(x[first:stop], rate_hz)
    return out


def _integral(x: Array, rate_hz: float) -> Array:
    rising = (np.cumsum(x, axis=0) - 0.5 * x) / rate_hz
    line = np.linspace(-1.0, 1.0, len(x))[:, None]
    trend = np.sum(line * rising, axis=0) / np.sum(line * line)
    return np.asarray(2.0 * np.pi * (rising - rising.mean(axis=0) - line * trend))


def without_corner(x: Array, rate_hz: float, corner_hz: float) -> Array:
    """Samples x (n, m) of a whole recording before the filter."""
    return x + corner_hz * integral(x, rate_hz) if corner_hz else x


def with_integral(pose: Pose) -> Pose:
    """Of windows whose channels are the reference's, then their integrals, which of themselves move nothing."""
    return replace(pose, direction=np.hstack([pose.direction, np.zeros_like(pose.direction)]))
