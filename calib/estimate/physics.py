"""V = S a + Q (Eq. 8) as it shows in a window: slopes and means as one function of some fifty inputs.

For output axis i, with the row S_i of S,

    a(t)            D u(t - lag) + R q u'(t) / omega + G,   G = R' G0 (1 + dg / |G0|)
    D               R (D0 + t L) (1 + T)^-1 / (1 + r)
    slope on u      S_i D (1 - lag^2 omega^2 / 2); S_i D within the own lag that the clocks leave open of a window
    slope on du/dt  -S_i D lag + S_i R q / omega
    mean of V       S_i (D mean(u) + G) + Q_i + S_i (R q / omega - lag D) mean(du/dt), and Q's change with temperature

R, R' turn the directions of motion and of gravity, r is the relative error of the reference, t and q the relative
motion along L that a uniaxial reference does not measure, in phase and 90 deg ahead. A reference with three axes
indicates (1 + r) (1 + T) times its motion; T has its transverse sensitivities, and zeros for the main ones. S is that
at the reference frequency, S0 that at 0 Hz, for gravity and means. What the front end leaves of the response over
frequency is small: it adds to the slopes, and to ln(S0 / S), linearly. Were its square in the equations, terms that no
motion tells would go where noise makes the square small.

Each unknown acts on the inputs linearly (calib.estimate.unknowns); S and r are those at the temperature of the window.
So the derivative by the unknowns is the one by the inputs times a constant matrix for each window, and the one by the
inputs comes from a complex step: none is written by hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np

from calib.model import Array, own_channels
from calib.signal.response import by_term
from calib.windows.record import TERMS, Record
from calib.windows.type_a import Index

WITHIN_U = 4.0  # of what the clocks leave open of a window's own lag: a lag further away is another common one
STEP = 1e-30  # of the complex step: its square is lost beside 1, so that the derivative is exact
AT_ONCE = 1000  # windows times inputs whose derivatives are found together: some 3 MB
_PARTS = {
    "S": 9, "Q": 3, "TURN": 3, "TURN_GRAVITY": 3, "ACROSS": 3, "AHEAD": 3, "LAG": 3, "CORNER": 1,
    "GRAVITY": 1, "REFERENCE": 3, "RESPONSE": TERMS, "OVER_T": 6, "ACROSS_REFERENCE": 6,
}  # fmt: skip
_ENDS = np.cumsum([0, *_PARTS.values()]).tolist()
(
    S, Q, TURN, TURN_GRAVITY, ACROSS, AHEAD, LAG, CORNER, GRAVITY, REFERENCE, RESPONSE, OVER_T, ACROSS_REFERENCE
) = (slice(first, stop) for first, stop in pairwise(_ENDS))  # fmt: skip
SIZE = _ENDS[-1]  # of the inputs
BESIDE = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))  # axis of the reference, and of the motion that it shows


@dataclass(frozen=True, slots=True, eq=False)
class Stack:
    """What the physics needs of W windows with M channels and k rows of means, each (W, ...), under the names that
    calib.windows.record.Record has for them. `direction` (W, 3, M) and `gravity_mps2` (W, 3) as stated, NaN where
    nobody stated gravity; `response` (W, TERMS). `excited` (W, 3, 3) is the identity where all directions count."""

    direction: Array
    gravity_mps2: Array
    along: Array
    along_rate_s: Array
    excited: Array
    root: Array
    slopes: Array
    passed: Array
    omega2: Array
    u_lag_s: Array
    noise: Array
    mean_x: Array
    means: Array
    over_t: Array
    temperature_degc: Array
    held_mps2: Array
    response: Array

    @classmethod
    def of(cls, records: Sequence[Record], *, fixed: bool) -> Stack:
        """That of records with equal numbers of channels and rows. `fixed`: they are of a mount that never turns."""
        same = {f.name for f in fields(cls)} & {f.name for f in fields(Record)}
        own = {name: [getattr(r, name) for r in records] for name in same}
        own["direction"] = [padded(r.pose.direction, r.channels) for r in records]
        own["gravity_mps2"] = [r.pose.gravity_mps2 for r in records]
        own["response"] = [np.pad(np.array(r.response), (0, TERMS - len(r.response))) for r in records]
        own["excited"] = [r.excited if fixed or r.planar else np.eye(3) for r in records]
        return cls(**{name: np.array(values) for name, values in own.items()})


def padded(direction: Array, channels: int) -> Array:
    """A direction (3, m) with columns of zeros for the channels that a window does not have."""
    return np.pad(direction, ((0, 0), (0, channels - direction.shape[1])))


class Windows:
    """W windows with equal numbers of channels and rows: what they show for given inputs.

    Along directions that a window did not excite its motion is mostly noise of the reference; there S is taken as
    `nominal` (3, 3). None: all directions count.

    `held_mps2` (3,): the mean input acceleration of a mount that never turns against gravity, which acts all the time.
    The mean of V is then one number for each axis, and takes the place of Q: Q = mean - S held is computed when it is
    read. If Q itself were an unknown, a mean that drifts would move the column of S along gravity. None: a mount that
    turns.
    """

    def __init__(
        self,
        stack: Stack,
        zero_degc: float = 0.0,
        nominal: Array | None = None,
        held_mps2: Array | None = None,
        *,
        at_hz: float,
        share: float | Array,
        known_size: float,
    ) -> None:
        """`zero_degc` is the temperature of S and Q. S holds at the frequency `at_hz`; of ln |h| the part 1 - `share`
        is the sensor's, of each term or (TERMS,), and it has known filters of size exp(`known_size`) there."""
        self.stack, self.channels = stack, stack.along.shape[1]
        self.silent = np.zeros((3, 3)) if nominal is None else nominal @ (np.eye(3) - stack.excited)
        self.away = None if held_mps2 is None else np.nan_to_num(stack.held_mps2 - held_mps2)
        # Where nobody stated gravity the means tell nothing, and get no weight.
        self.known = np.array(np.isfinite(stack.gravity_mps2).all(axis=1), dtype=bool)
        self.gravity = np.where(self.known[:, None], stack.gravity_mps2, 0.0)
        self.told_degc = np.array(np.isfinite(stack.temperature_degc), dtype=bool)
        self.over_t = _about(stack.over_t, np.where(self.told_degc, zero_degc, 0.0))
        omega = np.sqrt(stack.omega2)
        self.per_omega = np.divide(1.0, omega, out=np.zeros_like(omega), where=omega > 0.0)
        self.at_hz = (1.0 - share) * by_term(np.array([2.0 * np.pi * at_hz]), TERMS)[0].real
        self.removed = stack.response @ self.at_hz + known_size

    @property
    def moved(self) -> Array:
        """(W, 2M, 3) derivatives of the slopes of an axis by its row of S, with angles as stated."""
        own = self.stack
        direction = np.concatenate([own.direction @ own.along, own.direction @ own.along_rate_s], axis=2)
        return np.asarray(own.root @ direction.mT)

    def predicted(self, p: Array) -> tuple[Array, Array]:
        """Slopes R b (..., W, 2M, 3) and means (..., W, k, 3) for inputs (..., W, SIZE)."""
        s = p[..., S].reshape(*p.shape[:-1], 3, 3) * np.exp(-self.removed)[:, None, None]
        left = p[..., RESPONSE] @ self.at_hz  # of ln |h| at the reference frequency
        at_0hz = s * (1.0 - left)[..., None, None]
        direction, ahead = self._motion(p)
        slopes = self._slopes(p, s, direction, ahead, left)
        if self.away is None:
            level = p[..., Q] + self._under_gravity(p, at_0hz, direction, ahead)
        else:  # the input acts the same all the time, so that the mean of V tells no part of it
            level = p[..., Q] + _times(at_0hz.real, self.away)
        over = np.stack([level, p[..., OVER_T][..., :3], p[..., OVER_T][..., 3:]], axis=-2)
        return slopes, self.over_t @ over

    def under_gravity(self, p: Array) -> Array:
        """(..., W, 3) the part of the mean of V that is not Q."""
        s = p[..., S].reshape(*p.shape[:-1], 3, 3) * np.exp(-self.removed)[:, None, None]
        at_0hz = s * (1.0 - p[..., RESPONSE] @ self.at_hz)[..., None, None]
        return self._under_gravity(p, at_0hz, *self._motion(p))

    def _under_gravity(self, p: Array, s: Array, direction: Array, ahead: Array) -> Array:
        output = _times(s, felt_gravity(p, self.gravity))
        if self.channels:
            mean, rate = np.split(self.stack.mean_x, 2, axis=1)
            output = output + _times(s, _times(direction, mean) + ahead * rate[:, :1])
            output = output - p[..., LAG] * _times(s, _times(direction, rate))
        return output

    def _motion(self, p: Array) -> tuple[Array, Array]:
        """D (..., W, 3, M), for means and motion that each channel has by itself, and R q / omega (..., W, 3)."""
        ahead = _times(rotation(p[..., TURN]), p[..., AHEAD]) * self.per_omega[:, None]
        return felt_motion(p, self.stack.direction), ahead

    def _slopes(self, p: Array, s: Array, direction: Array, ahead: Array, left: Array) -> Array:
        if not self.channels:
            return np.zeros((*p.shape[:-1], 0, 3))
        own, lag = self.stack, p[..., LAG]
        # The front end took a window's own lag out: what the common one differs from it is not left in the window.
        left_s = np.where(np.abs(lag.real) > WITHIN_U * own.u_lag_s[:, None], lag, 0.0)
        s = s @ own.excited + self.silent
        ideal = s @ (direction @ own.along)
        on_u = ideal * (1.0 - 0.5 * left_s**2 * own.omega2[:, None])[..., None]
        on_rate = s @ (direction @ own.along_rate_s) - ideal * lag[..., None]
        on_rate = on_rate + _times(s, ahead)[..., None] * np.eye(1, self.channels)[0]
        slopes = own.root @ np.concatenate([on_u - left[..., None, None] * ideal, on_rate], axis=-1).mT
        if own.passed.any():
            flat = own.passed.reshape(len(own.passed), TERMS, -1)
            added = (p[..., RESPONSE][..., None, :] @ flat)[..., 0, :]
            slopes = slopes + added.reshape(*p.shape[:-1], 2 * self.channels, self.channels) @ ideal.mT
        return np.asarray(slopes)

    def linear(self, p: Array, near: Array, live: Index) -> tuple[Array, Array, Array, Array]:
        """Residuals, observed less predicted, of slopes (W, 6M) and means (W, 3k) at inputs `p` (W, SIZE); and their
        derivatives (W, ..., L) by the inputs numbered `live` (L,), at inputs `near` (W, SIZE)."""
        w, told = len(p), (self.stack.slopes, self.stack.means)
        slope, mean = ((observed - x).reshape(w, -1) for observed, x in zip(told, self.predicted(p), strict=True))
        d_slope, d_mean = (np.zeros((*left.shape, len(live))) for left in (slope, mean))
        parts = min(-(-len(live) * w // AT_ONCE), len(live)) or 1
        for part in np.array_split(np.arange(len(live)), parts):
            step = np.zeros((len(part), 1, SIZE), complex)
            step[range(len(part)), 0, live[part]] = 1j * STEP
            for found, x in zip((d_slope, d_mean), self.predicted(near + step), strict=True):
                found[..., part] = np.moveaxis(x.imag.reshape(len(part), w, -1), 0, -1) / STEP
        return slope, mean, d_slope, d_mean


def felt_motion(p: Array, direction: Array) -> Array:
    """D (..., 3, M) for inputs (..., SIZE) and directions as stated (..., 3, M).

    A corner of c Hz removed c times the integral; the integrals are channels of their own (calib.signal.corner).
    """
    channels = direction.shape[-1]
    real = own_channels(channels)
    sideways = direction + p[..., ACROSS][..., None] * np.eye(1, channels)[0]
    felt = rotation(p[..., TURN]) @ sideways[..., :real]
    if real == 3 and p[..., ACROSS_REFERENCE].any():
        felt = felt @ np.linalg.inv(np.eye(real) + indicated_beside(p[..., ACROSS_REFERENCE]))
    felt = np.concatenate([felt, p[..., CORNER][..., None] * felt], axis=-1)[..., :channels]
    channel = np.resize(np.arange(max(real, 1)), channels)  # integrals have the error of their own channel
    return np.asarray(felt / (1.0 + p[..., REFERENCE][..., channel])[..., None, :])


def indicated_beside(across: Array) -> Array:
    """T (..., 3, 3) of the transverse sensitivities (..., 6) of a reference, which stand as in BESIDE."""
    found = np.zeros((*across.shape[:-1], 3, 3), across.dtype)
    found[..., *np.array(BESIDE).T] = across
    return found


def felt_gravity(p: Array, gravity: Array) -> Array:
    """G (..., 3) for inputs (..., SIZE) and gravity as stated (..., 3) in m/s2."""
    magnitude = np.maximum(np.linalg.norm(gravity, axis=-1), np.finfo(float).tiny)
    turned = _times(rotation(p[..., TURN_GRAVITY]), gravity)
    return np.asarray(turned * (1.0 + p[..., GRAVITY] / magnitude[..., None]))


def rotation(v: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) by Rodrigues' formula; an imaginary part turns after
    the real one.

    So a common turn of all positions stays exactly what a turn of S is, however large the angles are. Derivatives of
    the sum of the rotation vectors would tell the two apart by a second order that nobody stated.
    """
    angle = np.sqrt((v.real**2).sum(axis=-1))[..., None, None]
    own = _cross(v.real)
    turn = np.eye(3) + np.sinc(angle / np.pi) * own + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * (own @ own)
    return np.asarray(turn + 1j * (_cross(v.imag) @ turn) if np.iscomplexobj(v) else turn)


def _cross(v: Array) -> Array:
    """Matrices (..., 3, 3) that give the vector product of v (..., 3) with another vector."""
    found = np.zeros((*v.shape, 3))
    found[..., [2, 0, 1], [1, 2, 0]], found[..., [1, 2, 0], [2, 0, 1]] = v, -v
    return found


def _times(matrix: Array, vector: Array) -> Array:
    """Matrices (..., n, k) times vectors (..., k)."""
    return (matrix @ vector[..., None])[..., 0]


def _about(over_t: Array, zero_degc: Array) -> Array:
    """Weights (W, k, 3) of (1, T, T^2) as those of (1, T - T0, (T - T0)^2), T0 (W,)."""
    to = np.zeros((len(zero_degc), 3, 3))
    to[:, range(3), range(3)] = 1.0
    to[:, 0, 1], to[:, 1, 2], to[:, 0, 2] = -zero_degc, -2.0 * zero_degc, zero_degc**2
    return over_t @ to
