"""How a portable reference is clamped beside a mounted sensor: whether it is turned, loose, or hardly moves.

The slopes M of the sensor's output V on the reference's motion u, and the mean of both, are

    M = S R T,    mean V = S R T mean u + Q

with the stated rotation R and the rotation T by which the reference is turned away from it. S and Q are known from
before with an uncertainty; so T follows, from gravity (mean u) and from the motion. A reference on a loose clamp moves
like a mass on a spring: its motion is 1 + (f / f0)^2 times that of the structure far below the resonance at f0, and a
part of it, which grows with the motion, has nothing to do with that of the structure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calib.distributions import chi2_quantile
from calib.model import Array, Window
from calib.windows.bands import without_integrals
from calib.windows.sums import merge, pool

FALSE_ALARM = 1e-3  # probability that a reference is called turned although its rotation is as stated
MOST_RISE = 0.05  # of the reference's motion at the upper end of the band; a filter of the sensor can do as much
MOST_RATTLE = 0.05  # of the motion, rms
SURE = 5.0  # standard uncertainties by which a rise or a rattle must exceed 0
LEAST_COHERENCE = 0.8  # of all bands together, without a rattle: below, noise hides the motion
STEPS = 8  # of Gauss-Newton; four are enough from the start below
FREE_RAD = 10.0  # standard uncertainty of T before any data: nothing is known
HALF_OCTAVES = 2.0  # bands in an octave
CLEAR = 0.03  # a band whose gain has a larger standard uncertainty, relative to it, tells nothing
EXACT = 1e-3  # of a gain: the filters of two instruments differ by as much
FEWEST_BANDS = 4
FEWEST = 30.0  # points beyond the unknowns of a regression


@dataclass(frozen=True, slots=True)
class ClampBand:
    """Between two frequencies: the least coherence of an axis, and output over motion relative to what is known."""

    low_hz: float
    high_hz: float
    coherence: float
    gain: float
    u_gain: float

    @property
    def middle_hz(self) -> float:
        """The geometric middle."""
        return float(np.sqrt(self.low_hz * self.high_hz))


@dataclass(frozen=True, slots=True, eq=False)
class Clamping:
    """What the windows of a visit tell of the clamp.

    `turned_deg` (3,): the rotation vector of T in the frame of the reference, with the standard uncertainties
    `u_turned_deg` (3,), and `turned` whether it contradicts what is stated. `rise`: by how much the output is smaller,
    relative to the reference's motion, in the uppermost band with motion, about `high_hz`, than at low frequencies.
    `rattle`: rms of what is not coherent and grows with the motion, relative to the motion. `coherence` is that of all
    bands together, of the worst axis. `moved_mps2` (3,) is the rms of the reference's channels, `noise_mps2` that of
    what does not grow with the motion.
    """

    turned: bool
    turned_deg: Array
    u_turned_deg: Array
    bands: tuple[ClampBand, ...]
    rise: float
    u_rise: float
    rattle: float
    u_rattle: float
    coherence: float
    high_hz: float
    moved_mps2: Array
    noise_mps2: float

    @property
    def resonant(self) -> bool:
        """Whether the response has a resonance above the band, as of a reference on a loose clamp."""
        return abs(self.rise) > max(MOST_RISE, SURE * self.u_rise)

    @property
    def rattles(self) -> bool:
        """Whether a part of the motion that grows with it is not common to both."""
        return self.rattle**2 > max(MOST_RATTLE**2, SURE * self.u_rattle**2)

    @property
    def drowned(self) -> bool:
        """Whether noise hides the motion."""
        return self.coherence < LEAST_COHERENCE and not self.rattles


def clamping(windows: Sequence[Window], known: Array, covariance: Array, u_rotation_rad: float) -> Clamping | None:
    """What windows of motion beside one reference tell; None where there are too few points.

    `known` (12,) and `covariance` (12, 12): S and Q as known before, in the sensor's unit. `u_rotation_rad` is the
    stated standard uncertainty of R about each axis.
    """
    moved = [w for w in windows if w.kind == "motion" and w.points and w.sums.reference_channels == 3]
    if not moved:
        return None
    sums = merge([w.sums for w in moved])
    whole = pool(sums)
    n, mean, scatter = float(whole.count[0]), whole.mean[0], whole.scatter[0]
    independent = float(np.mean([w.independent for w in moved]))
    if n * independent < FEWEST or not np.all(np.diag(scatter) > 0.0):
        return None
    basis, out = slice(0, 6), slice(6, 9)
    slopes = np.linalg.lstsq(scatter[basis, basis], scatter[basis, out], rcond=None)[0]  # (6, 3)
    residual = scatter[out, out] - slopes.T @ scatter[basis, out]
    inverse = np.linalg.pinv(scatter[basis, basis])[:3, :3]
    R = moved[0].pose.direction
    regression = _Regression(slopes[:3].T, inverse, residual / (n * independent), n, mean[:3], mean[out])
    turned_rad, spread = _turned(regression, R, known, covariance)
    total = spread + u_rotation_rad**2 * np.eye(3)
    chi2 = float(turned_rad @ np.linalg.solve(total, turned_rad))
    scale = float(np.sqrt(np.mean(known[[0, 4, 8]] ** 2)))
    noise, rattle, u_rattle = _rattle(sums.count, sums.scatter, slopes, scale)
    expected = known[:9].reshape(3, 3) @ R @ Rotation.from_rotvec(turned_rad).as_matrix()
    bands = _bands(moved, expected)
    rise, u_rise = _rise(bands)
    explained = 1.0 - np.diag(residual) / np.diag(scatter)[out]
    high_hz = max((b.middle_hz for b in bands if _clear(b)), default=0.0)
    return Clamping(
        chi2 > chi2_quantile(1.0 - FALSE_ALARM, 3.0), np.degrees(turned_rad), np.degrees(np.sqrt(np.diag(spread))),
        bands, rise, u_rise, rattle, u_rattle, float(explained.min()), high_hz,
        np.sqrt(np.diag(scatter)[:3] / n), noise,
    )  # fmt: skip


class _Regression(NamedTuple):
    """Of indications on the reference: `slopes` (3, 3) have the covariance `residual` (3, 3) of one point times
    `inverse` (3, 3). `u`, `V` (3,) are means over `n` points.
    """

    slopes: Array
    inverse: Array
    residual: Array
    n: float
    u: Array
    V: Array


def _turned(regression: _Regression, R: Array, known: Array, covariance: Array) -> tuple[Array, Array]:
    """Rotation vector (3,) of T in rad and its covariance, by least squares on slopes, means, and S and Q as known."""
    slopes, inverse, residual, n, u, V = regression
    S, Q = known[:9].reshape(3, 3).copy(), known[9:].copy()
    # The start: the rotation nearest to S^-1 M, each direction weighted by the motion and by gravity.
    seen = R.T @ np.linalg.solve(
        S, np.column_stack([slopes @ _root(inverse), V - Q if _offset_determined(covariance) else V])
    )
    left, _, right = np.linalg.svd(seen @ np.column_stack([_root(inverse), u]).T)
    T = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    noise = np.zeros((12, 12))
    noise[:9, :9] = np.kron(residual, inverse)
    noise[9:, 9:] = residual / n
    prior = np.zeros((15, 15))
    prior[:12, :12], prior[12:, 12:] = np.linalg.inv(covariance), np.eye(3) / FREE_RAD**2
    # Singular where an axis has no noise at all.
    weight = np.linalg.inv(noise + np.diag(np.full(12, 1e-18 * float(np.mean(S**2)))))
    for _ in range(STEPS):
        turned = R @ T
        J = np.zeros((12, 15))
        J[:9, :9] = np.kron(np.eye(3), turned.T)
        J[9:, :9], J[9:, 9:12] = np.kron(np.eye(3), turned @ u), np.eye(3)
        for k, axis in enumerate(np.eye(3)):
            by = S @ turned @ _cross(axis)
            J[:9, 12 + k], J[9:, 12 + k] = by.ravel(), by @ u
        off = np.append((slopes - S @ turned).ravel(), V - S @ turned @ u - Q)
        away = np.append(known - np.append(S.ravel(), Q), -Rotation.from_matrix(T).as_rotvec())
        information = J.T @ weight @ J + prior
        step = np.linalg.solve(information, J.T @ weight @ off + prior @ away)
        S, Q = S + step[:9].reshape(3, 3), Q + step[9:12]
        T = T @ Rotation.from_rotvec(step[12:]).as_matrix()
    return np.asarray(Rotation.from_matrix(T).as_rotvec()), np.asarray(np.linalg.inv(information)[12:, 12:])


def _offset_determined(covariance: Array) -> bool:
    """Whether Q is known so well that gravity tells a direction."""
    return bool(np.trace(covariance[9:, 9:]) < np.trace(covariance[:9, :9]) * 100.0)


def _root(inverse: Array) -> Array:
    """(3, 3) whose square is the scatter of the motion, relative to the largest."""
    values, vectors = np.linalg.eigh(inverse)
    root = vectors * np.sqrt(values.min() / values) @ vectors.T
    return np.asarray(root)


def _cross(axis: Array) -> Array:
    x, y, z = axis
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _rattle(count: Array, scatter: Array, slopes: Array, scale: float) -> tuple[float, float, float]:
    """rms of the noise in m/s2; rms of what grows with the motion over that motion, and its standard uncertainty.

    By a regression of the residuals' variance (K,) of the segments on the variance of their motion. The uncertainty is
    the root of that of the square.
    """
    full = count > count.max() / 2.0
    projection = np.vstack([-slopes, np.eye(3)])
    residual = np.einsum("ia,kij,ja->k", projection, scatter[full], projection) / count[full] / 3.0 / scale**2
    motion = np.trace(scatter[full][:, :3, :3], axis1=1, axis2=2) / count[full] / 3.0
    if np.count_nonzero(full) < 4 or motion.std() == 0.0:
        return float(np.sqrt(max(residual.mean(), 0.0))), 0.0, np.inf
    # Variances scatter in proportion to themselves, so each counts by its inverse square.
    rows = np.column_stack([np.ones_like(motion), motion])
    fitted = residual
    for _ in range(3):
        weight = 1.0 / np.maximum(fitted, 0.1 * residual.mean())
        found = np.linalg.lstsq(rows * weight[:, None], residual * weight, rcond=None)[0]
        fitted = rows @ found
    off = (residual - fitted) * weight
    spread = np.linalg.inv(rows.T @ (rows * weight[:, None] ** 2)) * (off @ off) / (len(motion) - 2)
    return float(np.sqrt(max(found[0], 0.0))), float(np.sqrt(max(found[1], 0.0))), float(spread[1, 1] ** 0.25)


def _bands(windows: Sequence[Window], expected: Array) -> tuple[ClampBand, ...]:
    """Coherence and gain by half octave, where there are enough points."""
    told = [without_integrals(w.bands) for w in windows if w.bands is not None and len(w.bands.points)]
    if not told:
        return ()
    low, high = (np.concatenate([getattr(b, name) for b in told]) for name in ("low_hz", "high_hz"))
    products = np.concatenate([b.products for b in told])
    points = np.concatenate([b.points * b.independent for b in told])
    place = np.floor(HALF_OCTAVES * np.log2(np.sqrt(np.maximum(low, high / 4.0) * high))).astype(int)
    found = []
    for k in np.unique(place):
        here = place == k
        n, z = float(points[here].sum()), products[here].sum(axis=0)
        if n < FEWEST:
            continue
        X = np.linalg.lstsq(z[:6, :6], z[:6, 6:], rcond=None)[0]
        residual = z[6:, 6:] - X.T @ z[:6, 6:]
        coherence = 1.0 - np.diag(residual) / np.maximum(np.diag(z)[6:], np.finfo(float).tiny) * n / (n - 6.0)
        # Output over what is expected of the motion, in the directions of the motion.
        like = np.vstack([expected.T, np.zeros((3, 3))])
        power = float(np.trace(like.T @ z[:6, :6] @ like))
        gain = float(np.trace(like.T @ z[:6, :6] @ X)) / power
        u = float(np.sqrt(np.trace(like.T @ z[:6, :6] @ like @ residual) / n)) / power
        found.append(ClampBand(float(low[here].min()), float(high[here].max()), float(coherence.min()), gain, u))
    return tuple(found)


def _rise(bands: Sequence[ClampBand]) -> tuple[float, float]:
    """How much more the reference moves at the upper end of the band, by gain = a (1 - c f^2), and its u."""
    clear = [b for b in bands if _clear(b)]
    if len(clear) < FEWEST_BANDS:
        return 0.0, np.inf
    middle_hz, gain, u = np.array([(b.middle_hz, b.gain, b.u_gain) for b in clear]).T
    rows = np.column_stack([np.ones_like(gain), -((middle_hz / middle_hz[-1]) ** 2)])
    weight = 1.0 / np.hypot(u, EXACT)
    a, c = np.linalg.lstsq(rows * weight[:, None], gain * weight, rcond=None)[0]
    spread = np.linalg.inv(rows.T @ (rows * weight[:, None] ** 2))
    return float(c / a), float(np.sqrt(spread[1, 1]) / abs(a))


def _clear(band: ClampBand) -> bool:
    """Whether motion and not noise tells the gain of a band."""
    return band.u_gain < CLEAR * band.gain and band.coherence > LEAST_COHERENCE
