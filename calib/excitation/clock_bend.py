"""How the lag between two devices changes within a stretch: what their clocks leave open, told by the motion itself.

A clock is a parabola below the arrivals of a minute (calib.signal.timing). Arrivals that scatter leave not only its
offset open, but its slope and its curvature too: 30 ms of scatter in the reads leave 3 ms between the middle and the
ends of a minute. In a motion that stays the same all the time, a lag that changes looks like noise, and makes slopes
smaller in second order. Where blows of several frequencies and directions come one after the other, it looks like
another S.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.excitation.detection import regression
from calib.excitation.windows import Points
from calib.model import Array, own_channels
from calib.signal.samples import Samples

# Standard uncertainties of the first and the second Legendre coefficient of a parabola that was fitted to evenly spaced
# points, over that of its value at the end: sqrt(2 k + 1) / 3.
OF_END = np.sqrt([3.0, 5.0]) / 3.0
# Of what the clocks leave open: what is further away is something else. Stalls are rare and long, so that two in 150
# minutes of late reads were right, and beyond 4.
WITHIN_U = 8.0
LEAST_RAD = 3e-3  # of phase that the clocks leave open: less changes S by less than 1e-5
TURNS = 3  # each one leaves some per cent of the bend
SEGMENTS, FEWEST_POINTS = 32, 20  # of a stretch, whose scatter is that of the result, and points in each
# Of the covariance: blows are few, and the residuals of one are alike. 60 drawn bends scatter by 1.4, in variance, and
# those of a crane whose instruments respond differently by 1.9.
FEW_BLOWS = 1.5
NOTHING = 1e-9  # of information, relative to that of the clocks


@dataclass(frozen=True, slots=True, eq=False)
class ClockBend:
    """What the lag of the sensor behind the motion is more than its mean, over the time `span_s` of its clock.

    `bend_s` (2,): coefficients in s of the first and the second Legendre polynomial; `root` (2, 2): a root of their
    covariance. `slopes` (m, 3): those of V on the reference's own channels.
    """

    span_s: tuple[float, float]
    bend_s: Array
    root: Array
    slopes: Array

    def at(self, time_s: Array) -> Array:
        """(n,) the lag in s at these times (n,), less its mean."""
        return np.asarray(self.bend_s @ _legendre(time_s, self.span_s))

    def taken_out(self, sensor: Samples) -> Samples:
        """The sensor's samples at the times at which they follow the motion best."""
        return replace(sensor, clock=sensor.clock.bent(-self.bend_s))

    def left_in(self, points: Points) -> Array:
        """(2, 2k, 3) what the slopes of V on u and du/dt of a window are more, for one standard uncertainty of each of
        two independent parts of the bend."""
        basis = _basis(points)
        moved = np.stack([regression(basis, one)[:, 1:].T for one in self.derivatives(points)])
        return np.asarray(np.einsum("kri,kl->lri", moved, self.root))

    def derivatives(self, points: Points) -> Array:
        """(2, 3, n) derivatives of V at these points by the coefficients."""
        rate = (points.du[:, : len(self.slopes)] @ self.slopes).T
        return np.asarray(-_legendre(points.time_s, self.span_s)[:, None] * rate)


def clock_bend(sensor: Samples, reference: Samples, points: Points, independent: float) -> ClockBend | None:
    """The bend by the clocks and the motion together; None where the clocks leave nothing open that matters, or where
    the motion tells more than the clocks can explain.

    `points` are those of both devices at the same times, with the mean lag taken out but for a part, which stays;
    `independent` is the share of them that are.
    """
    n, m = len(points.time_s), own_channels(points.u.shape[1])
    one_parabola = all(len(one.clock.knot_index) == 2 for one in (sensor, reference))  # as of no long file
    if not one_parabola or n < SEGMENTS * FEWEST_POINTS or not (np.diff(points.time_s) > 0.0).all():
        return None
    u_end_s = float(np.hypot(sensor.clock.u_offset_s, reference.clock.u_offset_s))
    moved, rate = (float(np.linalg.norm(one[:, :m] - one[:, :m].mean(axis=0))) for one in (points.u, points.du))
    if not rate * u_end_s > LEAST_RAD * moved:
        return None
    unit_s, mean_s = OF_END * u_end_s, 0.0
    begun_s, ended_s = sensor.clock.knot_time_s.tolist()
    found = ClockBend((begun_s, ended_s), np.zeros(2), np.diag(unit_s), np.zeros((m, 3)))
    second = np.gradient(points.du, points.time_s, axis=0)
    for _ in range(TURNS):
        at_s = points.time_s - found.at(points.time_s) - mean_s
        u, du = (_at(at_s, points.time_s, *own) for own in ((points.u, points.du), (points.du, second)))
        found, left_s = _nearer(found, points._replace(u=u, du=du), unit_s, independent)
        mean_s += left_s
    return found if (np.abs(found.bend_s) <= WITHIN_U * unit_s).all() else None


def _nearer(before: ClockBend, points: Points, unit_s: Array, independent: float) -> tuple[ClockBend, float]:
    """The next one of the iteration, and the mean lag in s that is left, from points of which `before` was taken out.
    `unit_s` (2,): what the clocks leave open.

    V is regressed on the motion and on the derivatives by the coefficients, by least squares. The coefficients'
    covariance is that of noise of the spectrum of the motion, or that of the sums over segments, each predicted by the
    others, if this is larger: blows are few, and the residuals of each are alike.
    """
    n, m = points.u.shape[0], len(before.slopes)
    basis = _with_derivatives(points)
    by_motion = regression(basis, points.V.T)
    slopes, rates = by_motion[:, 1 : 1 + m].T, by_motion[:, 1 + points.u.shape[1] :][:, :m].T
    now = replace(before, slopes=slopes)
    by_unit = now.derivatives(points) * unit_s[:, None, None]
    rest, *moved = (own - regression(basis, own) @ basis for own in (points.V.T, *by_unit))
    sd = np.sqrt(np.maximum(np.mean(rest**2, axis=1), np.finfo(float).tiny))[:, None]
    rest, by_bend = rest / sd, np.stack(moved) / sd
    information = np.einsum("kon,lon->kl", by_bend, by_bend) + NOTHING * np.eye(2)
    step = np.linalg.solve(information, np.einsum("kon,on->k", by_bend, rest))
    left = rest - np.einsum("kon,k->on", by_bend, step)
    starts = np.linspace(0, n, SEGMENTS + 1).astype(np.int64)[:-1]
    sums = np.add.reduceat(np.einsum("kon,on->nk", by_bend, left), starts, axis=0)
    others = information + np.eye(2) - np.add.reduceat(np.einsum("kon,lon->nkl", by_bend, by_bend), starts, axis=0)
    each = np.linalg.solve(others, sums[..., None])[..., 0]
    by_points = np.linalg.inv(information) / max(independent, 1.0 / n)
    covariance = FEW_BLOWS * max(each.T @ each, by_points, key=np.trace)
    gain = np.linalg.solve(np.eye(2) + covariance, np.eye(2))
    root = np.asarray(unit_s[:, None] * np.linalg.cholesky(gain @ covariance), np.float64)
    left_s = -float(np.sum(slopes * rates) / max(float(np.sum(slopes**2)), np.finfo(float).tiny))
    return replace(now, bend_s=unit_s * (gain @ (before.bend_s / unit_s + step)), root=root), left_s


def _at(at_s: Array, time_s: Array, values: Array, rates: Array) -> Array:
    """(q, m) values at times (q,), from values (n, m) and their derivatives at times (n,), by cubic pieces."""
    k = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    width_s = (time_s[k + 1] - time_s[k])[:, None]
    x = (at_s - time_s[k])[:, None] / width_s
    rise = values[k + 1] - values[k]
    before, after = width_s * rates[k] - rise, rise - width_s * rates[k + 1]
    return np.asarray(values[k] + x * rise + x * (1.0 - x) * ((1.0 - x) * before + x * after))


def _basis(points: Points) -> Array:
    """(p, n) 1, u and du/dt."""
    return np.vstack([np.ones((1, len(points.u))), points.u.T, points.du.T])


def _with_derivatives(points: Points) -> Array:
    """(p, n) as `_basis`, with the second and the third derivative of the reference's own channels: where instruments
    delay 14 Hz more than 1 Hz, the lag would seem to change whenever one of them takes the other's place."""
    rate, more = points.du[:, : own_channels(points.u.shape[1])].T, []
    for _ in range(2):
        rate = np.gradient(rate, points.time_s, axis=1)
        more.append(rate)
    return np.vstack([_basis(points), *more])


def _legendre(time_s: Array, span_s: tuple[float, float]) -> Array:
    """(2, n) the first and the second Legendre polynomial over a span; straight beyond its ends, as clocks are."""
    x = (2.0 * time_s - span_s[0] - span_s[1]) / (span_s[1] - span_s[0])
    inside = np.clip(x, -1.0, 1.0)
    return np.asarray([x, 1.5 * inside**2 - 0.5 + 3.0 * np.abs(x - inside)])
