"""How the lag between two devices changes within a stretch: what their clocks leave open, told by the motion itself.

A clock is a parabola below the arrivals of a minute (calib.signal.timing). Arrivals that scatter leave not only its
offset open, but its slope and its curvature too: 30 ms of scatter in the reads leave 3 ms between the middle and the
ends of a minute. In a motion that stays the same all the time, a lag that changes looks like noise. Where blows of
several frequencies and directions come one after the other, it looks like another S.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.excitation.windows import Points
from calib.model import Array, own_channels
from calib.signal.samples import Samples

# Standard uncertainties of the first and the second Legendre coefficient of a parabola that was fitted to evenly spaced
# points, over that of its value at the end: sqrt(2 k + 1) / 3.
OF_END = np.sqrt([3.0, 5.0]) / 3.0
WITHIN_U = 4.0  # of what the clocks leave open: what is further away is something else
LEAST_RAD = 3e-3  # of phase that the clocks leave open: less changes S by less than 1e-5
SEGMENTS = 32  # the scatter between them is that of the result
FEWEST_POINTS = 20  # in a segment


def bent(sensor: Samples, reference: Samples, points: Points) -> Samples | None:
    """The sensor's samples at the times at which they follow the motion best; None where the motion tells no change of
    the lag within the stretch, or no more of it than the clocks.

    `points` are those of both at the same times, with the mean lag taken out but for a part. The mean lag stays.
    """
    of_both = sensor.clock, reference.clock
    u_end_s = float(np.hypot(sensor.clock.u_offset_s, reference.clock.u_offset_s))
    n, m = len(points.time_s), own_channels(points.u.shape[1])
    if any(len(clock.knot_index) != 2 for clock in of_both) or n < SEGMENTS * FEWEST_POINTS:
        return None  # the clock of a long file is not one parabola
    moved, rate = (float(np.linalg.norm(one[:, :m] - one[:, :m].mean(axis=0))) for one in (points.u, points.du))
    if not rate * u_end_s > LEAST_RAD * moved:
        return None
    found_s, covariance = _told(points)
    prior = np.diag((OF_END * u_end_s) ** 2)
    if not (covariance.diagonal() < prior.diagonal()).all() or (np.abs(found_s) > WITHIN_U * OF_END * u_end_s).any():
        return None
    bend_s = prior @ np.linalg.solve(prior + covariance, found_s)
    if (np.abs(bend_s) < np.sqrt(covariance.diagonal())).all():
        return None
    span_s = float(points.time_s[0]), float(points.time_s[-1])
    return replace(sensor, clock=sensor.clock.bent(-bend_s, span_s))


def _told(points: Points) -> tuple[Array, Array]:
    """Coefficients (2,) in s of the first and the second Legendre polynomial, over the time of the points, of the lag
    of V behind the motion, and their covariance (2, 2).

    With V = A u + B du + c by least squares, V rises by -p(t) A du where the lag is p(t) more than in the mean. What
    the regressors explain of this is taken out of it. The covariance is that of the sums over segments, so that noise
    of any colour has its part in it.
    """
    n, m = len(points.time_s), own_channels(points.u.shape[1])
    design = np.column_stack([np.ones(n), points.u, points.du])
    slopes = np.linalg.lstsq(design, points.V, rcond=None)[0]
    expected_rate = points.du[:, :m] @ slopes[1 : 1 + m]
    x = np.interp(points.time_s, points.time_s[[0, -1]], [-1.0, 1.0])
    columns = np.hstack([points.V, *(-one[:, None] * expected_rate for one in (x, 1.5 * x**2 - 0.5))])
    columns -= design @ np.linalg.lstsq(design, columns, rcond=None)[0]
    rest, by_lag = columns[:, :3], columns[:, 3:].reshape(n, 2, 3)
    scale = np.sqrt(np.maximum(np.mean(rest**2, axis=0), np.finfo(float).tiny))
    rest, by_lag = rest / scale, by_lag / scale
    information = np.einsum("nko,nlo->kl", by_lag, by_lag)
    found_s = np.linalg.solve(information, np.einsum("nko,no->k", by_lag, rest))
    left = rest - np.einsum("nko,k->no", by_lag, found_s)
    edges = np.linspace(0, n, SEGMENTS + 1).astype(np.int64)[:-1]
    scores = np.add.reduceat(np.einsum("nko,no->nk", by_lag, left), edges, axis=0)
    return found_s, np.linalg.solve(information, np.linalg.solve(information, scores.T @ scores).T)
