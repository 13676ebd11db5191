"""V = S a + Q (Eq. 8) as it shows in a window: slopes and means as one function of some fifty inputs.

For output axis i, with the row S_i of S at the temperature of the window,

    a(t)            D u(t - lag) + R q u'(t) / omega + G,   D = R (D0 + t L) / (1 + r),   G = R' G0 (1 + dg / |G0|)
    slope on u      S_i D (1 - lag^2 omega^2 / 2)
    slope on du/dt  -S_i D lag + S_i R q / omega
    mean of V       S_i (D mean(u) + G) + Q_i + S_i (R q / omega - lag D) mean(du/dt), and Q's change with temperature

R, R' turn the directions of motion and of gravity, r is the relative error of the reference, t and q the relative
motion along L that a uniaxial reference does not measure, in phase and 90 deg ahead. S is that at the reference
frequency, S0 that at 0 Hz, for gravity and means. What the front end leaves of the response over frequency is small:
it adds to the slopes, and to ln(S0 / S), linearly. Were its square in the equations, terms that no motion tells would
go where noise makes the square small.

Each unknown acts on the inputs linearly (calib.estimate.unknowns). So the derivative by the unknowns is the one by the
inputs times a constant matrix for each window, and the one by the inputs comes from a complex step: none is written by
hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calib.estimate.record import TERMS, TOLD, Record
from calib.estimate.type_a import Index
from calib.model import Array, own_channels
from calib.signal.response import by_term

STEP = 1e-30  # of the complex step: its square is lost beside 1, so that the derivative is exact
_PARTS = {
    "S": 9, "Q": 3, "STRETCH": 3, "TURN": 3, "TURN_GRAVITY": 3, "ACROSS": 3, "AHEAD": 3, "LAG": 3, "CORNER": 1,
    "GRAVITY": 1, "REFERENCE": 3, "RESPONSE": TERMS, "OVER_T": 6,
}  # fmt: skip
_ENDS = np.cumsum([0, *_PARTS.values()]).tolist()
(
    S, Q, STRETCH, TURN, TURN_GRAVITY, ACROSS, AHEAD, LAG, CORNER, GRAVITY, REFERENCE, RESPONSE, OVER_T
) = (slice(first, stop) for first, stop in pairwise(_ENDS))  # fmt: skip
SIZE = _ENDS[-1]  # of the inputs


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """A mount that never turns against gravity: the mean input acceleration `held_mps2` (3,) acts all the time, so that
    the mean of V is one number for each axis. It takes the place of Q: Q = mean - S held is computed when it is read.
    If Q itself were an unknown, a mean that drifts would move the column of S along gravity.

    `nominal` (3, 3): S before any data. It takes the place of S along directions that a window did not excite, since
    what moved there is mostly noise of the reference.
    """

    nominal: Array
    held_mps2: Array


class Windows:
    """The records of W windows with equal numbers of channels and rows, stacked (W, ...)."""

    def __init__(
        self,
        records: Sequence[Record],
        zero_degc: float,
        mount: Mount | None,
        at_hz: float,
        share: float,
        known_size: float,
    ) -> None:
        """`zero_degc` is the temperature of S and Q. `mount`: the mount if it never turns, else None.

        S holds at the frequency `at_hz`; of ln |h| the part 1 - `share` is the sensor's, which has known filters of
        size exp(`known_size`) there.
        """
        self.records, self.channels = records, records[0].channels
        m, real = self.channels, own_channels(self.channels)
        self.root, self.slopes, self.passed = (self._stack(name) for name in ("root", "slopes", "passed"))
        self.noise, self.mean_x, self.means = (self._stack(name) for name in ("noise", "mean_x", "means"))
        self.along, self.along_rate = self._stack("along"), self._stack("along_rate_s")
        self.excited = np.tile(np.eye(3), (len(records), 1, 1)) if mount is None else self._stack("excited")
        self.silent = (np.eye(3) if mount is None else mount.nominal) @ (np.eye(3) - self.excited)
        self.away = None if mount is None else np.nan_to_num(self._stack("held_mps2") - mount.held_mps2)
        self.told = np.zeros((len(records), TOLD, TERMS + 1))
        for own, record in zip(self.told, records, strict=True):
            own[: len(record.told)] = record.told
        self.direction = np.zeros((len(records), 3, m))
        for own, record in zip(self.direction, records, strict=True):
            own[:, : record.pose.direction.shape[1]] = record.pose.direction
        gravity = np.array([record.pose.gravity_mps2 for record in records])
        self.known = np.isfinite(gravity).all(axis=1)  # else the means have no information, and get no weight
        self.gravity = np.where(self.known[:, None], gravity, 0.0)
        self.magnitude = np.maximum(np.linalg.norm(self.gravity, axis=1), np.finfo(float).tiny)
        degc = self._stack("temperature_degc")
        self.told_degc = np.isfinite(degc)
        self.over_zero = np.where(self.told_degc, degc - zero_degc, 0.0)
        self.over_t = _about(self._stack("over_t"), np.where(self.told_degc, zero_degc, 0.0))
        self.omega2 = self._stack("omega2")
        omega = np.sqrt(self.omega2)
        self.per_omega = np.divide(1.0, omega, out=np.zeros_like(omega), where=omega > 0.0)
        self.at_hz = (1.0 - share) * by_term(np.array([2.0 * np.pi * at_hz]), TERMS)[0].real
        taken = np.zeros((len(records), TERMS))
        for own, record in zip(taken, records, strict=True):
            own[: len(record.response)] = record.response
        self.removed = taken @ self.at_hz + known_size
        self.channel = np.resize(np.arange(max(real, 1)), m)  # integrals have the error of their own channel
        self._real, self._first = real, np.eye(1, m)[0]

    def _stack(self, name: str) -> Array:
        return np.array([getattr(record, name) for record in self.records])

    @property
    def moved(self) -> Array:
        """(W, 2M, 3) derivatives of the slopes of an axis by its row of S, with angles as stated."""
        direction = np.concatenate([self.direction @ self.along, self.direction @ self.along_rate], axis=2)
        return np.asarray(self.root @ direction.mT)

    def predicted(self, p: Array) -> tuple[Array, Array]:
        """Slopes R b (..., W, 2M, 3) and means (..., W, k, 3) for inputs (..., W, SIZE)."""
        stretch = (1.0 + p[..., STRETCH] * self.over_zero[:, None]) * np.exp(-self.removed)[:, None]
        s = p[..., S].reshape(*p.shape[:-1], 3, 3) * stretch[..., None]
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
        """(..., W, 3) the part of the mean of V that is not Q, at the temperature of S and Q."""
        s = p[..., S].reshape(*p.shape[:-1], 3, 3) * np.exp(-self.removed)[:, None, None]
        at_0hz = s * (1.0 - p[..., RESPONSE] @ self.at_hz)[..., None, None]
        return self._under_gravity(p, at_0hz, *self._motion(p))

    def _under_gravity(self, p: Array, s: Array, direction: Array, ahead: Array) -> Array:
        gravity = (rotation(p[..., TURN_GRAVITY]) @ self.gravity[..., None])[..., 0]
        output = _times(s, gravity * (1.0 + p[..., GRAVITY] / self.magnitude[:, None]))
        if self.channels:
            mean, rate = np.split(self.mean_x, 2, axis=1)
            output = output + _times(s, _times(direction, mean) + ahead * rate[:, :1])
            output = output - p[..., LAG] * _times(s, _times(direction, rate))
        return output

    def _motion(self, p: Array) -> tuple[Array, Array]:
        """D (..., W, 3, M), for means and motion that each channel has by itself, and R q / omega (..., W, 3)."""
        turn = rotation(p[..., TURN])
        ahead = _times(turn, p[..., AHEAD]) * self.per_omega[:, None]
        if not self.channels:
            return np.zeros((*p.shape[:-1], 3, 0)), ahead
        sideways = self.direction + p[..., ACROSS][..., None] * self._first
        felt = turn @ sideways[..., : self._real]
        felt = np.concatenate([felt, p[..., CORNER][..., None] * felt], axis=-1)[..., : self.channels]
        return felt / (1.0 + p[..., REFERENCE][..., self.channel])[..., None, :], ahead

    def _slopes(self, p: Array, s: Array, direction: Array, ahead: Array, left: Array) -> Array:
        if not self.channels:
            return np.zeros((*p.shape[:-1], 0, 3))
        s, lag = s @ self.excited + self.silent, p[..., LAG]
        ideal = s @ (direction @ self.along)
        on_u = ideal * (1.0 - 0.5 * lag**2 * self.omega2[:, None])[..., None]
        on_rate = s @ (direction @ self.along_rate) - ideal * lag[..., None]
        on_rate = on_rate + _times(s, ahead)[..., None] * self._first
        slopes = self.root @ np.concatenate([on_u - left[..., None, None] * ideal, on_rate], axis=-1).mT
        if self.passed.any():
            flat = self.passed.reshape(len(self.passed), TERMS, -1)
            added = (p[..., RESPONSE][..., None, :] @ flat)[..., 0, :]
            slopes = slopes + added.reshape(*p.shape[:-1], 2 * self.channels, self.channels) @ ideal.mT
        return np.asarray(slopes)

    def linear(self, p: Array, near: Array, live: Index) -> tuple[Array, Array, Array, Array]:
        """Residuals, observed less predicted, of slopes (W, 6M) and means (W, 3k) at inputs `p` (W, SIZE); and their
        derivatives (W, ..., L) by the inputs numbered `live` (L,), at inputs `near` (W, SIZE)."""
        step = np.zeros((len(live), 1, SIZE), complex)
        step[range(len(live)), 0, live] = 1j * STEP
        w, found, moved = len(p), self.predicted(p), self.predicted(near + step)
        slope, mean = ((told - x).reshape(w, -1) for told, x in zip((self.slopes, self.means), found, strict=True))
        d_slope, d_mean = (np.moveaxis(x.imag.reshape(len(live), w, -1), 0, -1) / STEP for x in moved)
        return slope, mean, d_slope, d_mean


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
