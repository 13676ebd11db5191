"""How the lag between two devices changes within a stretch: what their clocks leave open, told by the motion itself.

A clock is a parabola below the arrivals of a minute (calib.signal.timing). Arrivals that scatter leave not only its
offset open, but its slope and its curvature too: 30 ms of scatter in the reads leave 3 ms between the middle and the
ends of a minute. In a motion that stays the same all the time, a lag that changes looks like noise. Where blows of
several frequencies and directions come one after the other, it looks like another S.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from calib.excitation.detection import regression
from calib.excitation.windows import Points
from calib.model import Array, own_channels
from calib.signal.samples import Samples

# Standard uncertainties of the first and the second Legendre coefficient of a parabola that was fitted to evenly spaced
# points, over that of its value at the end: sqrt(2 k + 1) / 3.
OF_END = np.sqrt([3.0, 5.0]) / 3.0
WITHIN_U = 4.0  # of what clocks and motion leave open: what is further away is something else
LEAST_RAD = 3e-3  # of phase: less changes S by less than 1e-5
SEGMENTS = 32  # the scatter between them is that of the result
TURNS = 3
FEWEST_POINTS = 20  # in a segment


@dataclass(frozen=True, slots=True, eq=False)
class ClockBend:
    """What the lag of the sensor behind the motion is more than its mean, over the time `span_s` of a stretch.

    `bend_s` (2,): coefficients in s of the first and the second Legendre polynomial; `root` (2, 2): a root of their
    covariance. `slopes` (m, 3): those of V on the reference's own channels.
    """

    span_s: tuple[float, float]
    bend_s: Array
    root: Array
    slopes: Array

    def taken_out(self, sensor: Samples) -> Samples:
        """The sensor's samples at the times at which they follow the motion best."""
        return replace(sensor, clock=sensor.clock.bent(-self.bend_s, self.span_s))

    def left_in(self, points: Points) -> Array:
        """(2, 2k, 3) what the slopes of V on u and du/dt of a window are more, for one standard uncertainty of each of
        two independent parts of the bend."""
        design = np.vstack([np.ones((1, len(points.u))), points.u.T, points.du.T])
        moved = np.stack([regression(design, one.T)[:, 1:].T for one in self._moved(points)])
        return np.asarray(np.einsum("kri,kl->lri", moved, self.root))

    def at(self, time_s: Array) -> Array:
        """(n,) the lag in s at these times (n,), less its mean."""
        x = np.interp(time_s, self.span_s, [-1.0, 1.0])
        return np.asarray(self.bend_s[0] * x + self.bend_s[1] * (1.5 * x**2 - 0.5))

    def _moved(self, points: Points) -> Array:
        """(2, n, 3) derivatives of V by the coefficients."""
        x = np.interp(points.time_s, self.span_s, [-1.0, 1.0])
        rate = points.du[:, : len(self.slopes)] @ self.slopes
        return np.asarray([-x[:, None] * rate, (0.5 - 1.5 * x[:, None] ** 2) * rate])


def clock_bend(sensor: Samples, reference: Samples, points: Points, independent: float) -> ClockBend | None:
    """The bend by the clocks and the motion together; None where the clocks leave nothing open that matters.

    `points` are those of both devices at the same times, with the mean lag taken out but for a part. It stays.
    """
    u_end_s = float(np.hypot(sensor.clock.u_offset_s, reference.clock.u_offset_s))
    n, m = len(points.time_s), own_channels(points.u.shape[1])
    if any(len(one.clock.knot_index) != 2 for one in (sensor, reference)) or n < SEGMENTS * FEWEST_POINTS:
        return None  # the clock of a long file is not one parabola
    moved, rate = (float(np.linalg.norm(one[:, :m] - one[:, :m].mean(axis=0))) for one in (points.u, points.du))
    if not rate * u_end_s > LEAST_RAD * moved:
        return None
    prior = np.diag((OF_END * u_end_s) ** 2)
    span_s = float(points.time_s[0]), float(points.time_s[-1])
    found = ClockBend(span_s, np.zeros(2), np.diag(OF_END * u_end_s), np.zeros((m, 3)))
    motion = CubicHermiteSpline(points.time_s, points.u, points.du)
    rates = CubicSpline(points.time_s, points.du)
    mean_s = 0.0
    for _ in range(TURNS):
        at_s = points.time_s - found.at(points.time_s) - mean_s
        late = points._replace(u=motion(at_s), du=rates(at_s))
        found, more_s = _nearer(found, late, prior, independent)
        mean_s += more_s
    told = found.bend_s**2 <= WITHIN_U**2 * prior.diagonal()
    return found if told.all() else None


def _nearer(before: ClockBend, points: Points, prior: Array, independent: float) -> tuple[ClockBend, float]:
    """The next one of the iteration, from the points of which `before` was taken out.

    V is regressed on the motion and on what the coefficients move, by least squares. Their covariance is that of the
    sums over segments, so that noise of any colour has its part in it.
    """
    n, m = points.u.shape[0], len(before.slopes)
    design = np.vstack([np.ones((1, n)), points.u.T, points.du.T])
    first = regression(design, points.V.T)
    slopes = first[:, 1 : 1 + m].T
    now = replace(before, slopes=slopes)
    columns = np.hstack([points.V, *now._moved(points)]).T
    columns = columns - np.vstack([regression(design, columns[k : k + 3]) for k in (0, 3, 6)]) @ design
    rest, by_bend = columns[:3].T, columns[3:].T.reshape(n, 2, 3)
    scale = np.sqrt(np.maximum(np.mean(rest**2, axis=0), np.finfo(float).tiny))
    rest, by_bend = rest / scale, by_bend / scale
    information = np.einsum("nko,nlo->kl", by_bend, by_bend)
    step_s = np.linalg.solve(information, np.einsum("nko,no->k", by_bend, rest))
    left = rest - np.einsum("nko,k->no", by_bend, step_s)
    edges = np.linspace(0, n, SEGMENTS + 1).astype(np.int64)[:-1]
    scores = np.add.reduceat(np.einsum("nko,no->nk", by_bend, left), edges, axis=0)
    of_each = np.add.reduceat(np.einsum("nko,nlo->nkl", by_bend, by_bend), edges, axis=0)
    without = information + np.linalg.inv(prior) - of_each
    scores = (information @ np.linalg.solve(without, scores[..., None]))[..., 0]
    by_segments = np.linalg.solve(information, np.linalg.solve(information, scores.T @ scores).T)
    by_points = np.linalg.inv(information) / independent
    covariance = max(by_segments, by_points, key=lambda found: float(np.trace(np.linalg.solve(prior, found))))
    gain = np.linalg.solve(prior + covariance, prior).T
    root = np.asarray(np.linalg.cholesky(gain @ covariance), np.float64)
    rates = first[:, 1 + points.u.shape[1] :][:, :m].T
    return replace(now, bend_s=gain @ (before.bend_s + step_s), root=root), -float(np.sum(slopes * rates) / np.sum(slopes**2))
