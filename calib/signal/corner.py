"""Correction for the first-order high-pass filter of an AC-coupled instrument.

The inverse of the filter is exact: true = x + c * integral of x, with the corner c in rad/s. A corner of 0.16 Hz that
is left uncorrected causes an error of 0.56 % between 0.5 and 8 Hz. A lag cannot describe it: the filter's output leads,
and by less time at higher frequencies. If the corner is to be estimated from the data, the windows hold the integral of
the recorded signal (before any correction) as further channels behind the reference's own. The window equations are
then exact, whatever corner was corrected before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.model import Array, Pose


def integral(x: Array, rate_hz: float) -> Array:
    """2 pi times the time integral of samples x (n, m) in m/s2; the result is in m/s2 s and as large as x at 1 Hz.

    Each stretch between missing samples (NaN) is integrated by itself; the result is NaN where samples are missing. The
    constant of integration does not matter, because a window has a constant of its own. Mean and linear trend are
    removed: otherwise the zero error of the instrument would make the integral grow without limit.
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
    """Samples x (n, m) of a whole recording as they were before a high-pass filter with the corner `corner_hz`."""
    return x + corner_hz * integral(x, rate_hz) if corner_hz else x


def with_integral(pose: Pose) -> Pose:
    """The pose for windows whose channels are those of the reference followed by their integrals.

    The columns of the integrals in `direction` are zero: they act only through an error of the corner.
    """
    return replace(pose, direction=np.hstack([pose.direction, np.zeros_like(pose.direction)]))
