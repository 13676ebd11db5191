"""The window equations of the adjustment: the predicted slopes and means, and their derivatives by every unknown.

They follow from V = S a + Q (Eq. 8) as calib.estimate.physics has it. Its term in omega^2 = <du^2> / <u^2> is the
projection of d2u/dt2 on u. It is exact for a sine, and for any motion after the front end has removed the lag that was
found, because the remaining lag is then negligible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib.adjustment.slope_scatter import SlopeScatter
from calib.estimate import physics
from calib.estimate.nuisances import Applied, Priors
from calib.estimate.physics import Windows
from calib.estimate.terms import Nuisances
from calib.model import Array, Pose
from calib.windows.condense import Condensed
from calib.windows.never_turned import never_turned
from calib.windows.record import TERMS

# Least singular value of an excited direction, relative to the largest (columns scaled to one). It is 3e-6 for clamp
# positions of 0, 1 and 2 deg; rounding errors alone give 1e-15.
RANK_TOLERANCE = 1e-10
# Largest component of a parameter along a direction without excitation for which the parameter still counts as seen. A
# silent channel shares up to 1 % of another channel's motion (calib.windows.excited). A direction without excitation
# is held at its scale, so u contains that component.
UNSEEN_SHARE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class WhitenedRows:
    """Whitened residuals (observed minus predicted), and the derivatives of the predictions.

    Slopes: `slope` (W, 2M, 3) and `d_slope` (W, 2M, 3, N); means: `mean` (W, 3) and `d_mean` (W, 3, N); what the bands
    tell of the response: `band` (R,) and `d_band` (R, N). The N unknowns are [S row by row, Q, nuisances].
    """

    slope: Array
    d_slope: Array
    mean: Array
    d_mean: Array
    band: Array
    d_band: Array

    def stacked(self) -> tuple[Array, Array]:
        """Residuals (rows,) and Jacobian (rows, N), the slopes first, then the means, then the bands."""
        n = self.d_mean.shape[-1]
        residual = np.concatenate([self.slope.ravel(), self.mean.ravel(), self.band])
        return residual, np.vstack([self.d_slope.reshape(-1, n), self.d_mean.reshape(-1, n), self.d_band])


class Equations:
    """The window equations of W condensed windows, with their poses and weights, as functions for Gauss-Newton.

    `output_per_mps2` is the sensor's scale in output unit per m/s2, as stated or from the data. `known` (W,): gravity
    is known in the pose of the window; else its mean has no information and gets no weight.
    """

    def __init__(
        self,
        data: Condensed,
        held: Sequence[Pose],
        priors: Priors,
        applied: Applied,
        scatter: SlopeScatter,
        ways: Array | None = None,
    ) -> None:
        """`held` are the poses of the windows, `scatter` that of the slopes. `ways` (3, k), orthonormal: the directions
        that the windows excite; None: all. A nuisance turns the motion out of them, but what the slopes then show of S
        in other directions is of second order, and mostly noise: the slopes tell nothing of it.
        """
        self.data, self.scatter = data, scatter
        poses = {p.setting: p for p in held}
        number = {setting: k for k, setting in enumerate(poses)}
        self._pose_of = np.array([number[p.setting] for p in held])
        self.nuisances = Nuisances(list(poses.values()), data.channels, priors, applied)
        self._excited = None if ways is None or ways.shape[1] == len(ways) else ways @ ways.T
        self._stack = _stack(data, held, self.nuisances.applied_response, self._excited)
        self.known = np.array([np.isfinite(p.gravity_mps2).all() for p in held])
        self.output_per_mps2 = priors.output_per_mps2 or self._output_per_mps2()
        self._windows = Windows(
            self._stack, nominal=self.likely, at_hz=priors.reference_frequency_hz, share=priors.reference_shares,
            known_size=priors.known_size,
        )  # fmt: skip
        self._effect = self.nuisances.effect.copy()
        self._effect[:, physics.Q] *= self.output_per_mps2
        noise2 = data.type_a.noise**2 / data.count[:, None]
        variance = noise2 + (priors.offset_mps2 * self.output_per_mps2) ** 2
        self.mean_weight = np.where(self.known[:, None], 1.0 / np.sqrt(variance), 0.0)
        self.white_share = np.where(self.known[:, None], noise2 / variance, 0.0)

    @property
    def gravity_mps2(self) -> Array:
        """(W, 3) gravity in the pose of each window, 0 where it is not known."""
        return self._windows.gravity

    @cached_property
    def _moved(self) -> Array:
        """(W, M, 3) derivatives of the slopes on u by a row of S, with angles as stated."""
        m = self.data.channels
        return np.asarray(self.data.root[:, :m, :m] @ (self._stack.direction @ self._stack.along).mT)

    @cached_property
    def _held(self) -> Array:
        """(W, 3) mean input acceleration of each window, with angles as stated."""
        mean = self.data.mean_x[:, : self.data.channels, None]
        return np.asarray((self._stack.direction @ mean)[..., 0] + np.nan_to_num(self._stack.gravity_mps2))

    @cached_property
    def unseen(self) -> Array:
        """Directions (k, 4) of (a_x, a_y, a_z, 1) normal to every input vector, with angles as stated. The rank is
        4 - k."""
        moved, held, count = self._moved, self._held[self.known], self.data.count[self.known]
        if self._excited is not None:
            moved = moved @ self._excited
        if self._excited is not None and never_turned(held):  # what an AC-coupled reference shows in the mean is noise
            held, count = count[None] @ held / count.sum(), count.sum(keepdims=True)
        held = np.sqrt(count)[:, None] * np.pad(held, ((0, 0), (0, 1)), constant_values=1.0)
        rows = np.vstack([np.pad(moved.reshape(-1, 3), ((0, 0), (0, 1))), held])
        scale = np.linalg.norm(rows, axis=0)
        if self._excited is not None:  # the directions are not those of the axes
            scale[:3] = scale[:3].max()
        scale[scale == 0.0] = 1.0
        _, singular, ways = np.linalg.svd(np.vstack([rows / scale, np.zeros((4, 4))]), full_matrices=False)
        return np.asarray(ways[singular <= RANK_TOLERANCE * singular[0]] / scale)

    @property
    def rank(self) -> int:
        """The rank of the input vectors, 4 at most."""
        return 4 - len(self.unseen)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(12,) flags of the parameters (S row by row, then Q) that have no component in a direction of `unseen`."""
        parts = np.abs(self.unseen) / np.linalg.norm(self.unseen, axis=1, keepdims=True)
        free = parts.max(axis=0, initial=0.0) > UNSEEN_SHARE
        return ~np.concatenate([np.tile(free[:3], 3), np.repeat(free[3], 3)])

    @property
    def unexcited(self) -> Array:
        """(k, 3) directions in the sensor's frame, orthonormal, along which the data tell nothing of S."""
        _, size, ways = np.linalg.svd(np.vstack([self.unseen[:, :3], np.zeros((3, 3))]), full_matrices=False)
        ways = ways[size > UNSEEN_SHARE * max(size[0], np.finfo(float).tiny)]
        largest = np.take_along_axis(ways, np.argmax(np.abs(ways), axis=1)[:, None], axis=1)
        return np.asarray(ways * np.sign(largest))

    @property
    def likely(self) -> Array:
        """S (3, 3) along directions that are not excited, as a sensor has it whose axes are at right angles, alike and
        near the stated ones; zeros where all are excited. Only if S is not zero there, an angle that is uncertain shows
        in u of the rest."""
        if self._excited is None:
            return np.zeros((3, 3))
        slopes = self.data.slopes[:, : self.data.channels].reshape(-1, 3)
        told, *_ = np.linalg.lstsq((self._moved @ self._excited).reshape(-1, 3), slopes, rcond=RANK_TOLERANCE)
        silent = np.eye(3) - self._excited
        outputs, _, ways = np.linalg.svd(told.T @ self._excited / self.output_per_mps2 + silent)
        return np.asarray(self.output_per_mps2 * outputs @ ways @ silent)

    def _output_per_mps2(self) -> float:
        """The sensor's scale in output unit per m/s2: rms of the outputs over rms of the inputs, slopes and means."""
        data, m = self.data, self.data.channels
        gravity, n = self._held[self.known], data.count[self.known]
        held, level = np.zeros((1, 3)), np.zeros((1, 3))
        if n.size:
            held = np.sqrt(n)[:, None] * (gravity - n @ gravity / n.sum())
            level = np.sqrt(n)[:, None] * (data.mean_v[self.known] - n @ data.mean_v[self.known] / n.sum())
        inputs = float((self._moved**2).sum() + (held**2).sum())
        outputs = float((data.slopes[:, :m] ** 2).sum() + (level**2).sum())
        return float(np.sqrt(outputs / inputs)) if inputs > 0.0 and outputs > 0.0 else 1.0

    def at(self, x: Array) -> WhitenedRows:
        """Residuals and derivatives at x = [S row by row, Q, nuisances] (N,)."""
        data, n, w = self.data, len(x), len(self._pose_of)
        inputs = (self._effect @ x[12:])[self._pose_of]
        inputs[:, :12] += x[:12]
        live = np.union1d(np.arange(12), np.flatnonzero(self._effect.any(axis=(0, 2))))
        slope, mean, *by_inputs = self._windows.linear(inputs, inputs, live)
        jacobians = [np.zeros((w, left.shape[1], n)) for left in (slope, mean)]
        for found, by in zip(jacobians, by_inputs, strict=True):
            found[..., :12] = by[..., :12]
            for k, effect in enumerate(self._effect[:, live]):
                own = self._pose_of == k
                found[own, :, 12:] = by[own] @ effect
        del by_inputs  # of a day much memory
        # Of an output that tells nothing of S, no row has a weight.
        noise = np.tile(np.where(data.telling, data.type_a.noise, np.inf), 2 * data.channels)
        jacobians[0] /= noise[..., None]
        white = [self.scatter.whiten(part) for part in (slope / noise, jacobians[0])]
        shape, weight = data.slopes.shape, self.mean_weight
        return WhitenedRows(
            white[0].reshape(shape), white[1].reshape(*shape, n), mean * weight, jacobians[1] * weight[..., None],
            *self._bands(x[12:]),
        )  # fmt: skip

    def split(self, rows: Array) -> tuple[Array, Array]:
        """Stacked rows (rows, ...) back into slopes (W, 2M, 3, ...) and means (W, 3, ...); those of bands are left."""
        slopes, means = self.data.slopes, self.data.mean_v
        return (
            rows[: slopes.size].reshape(*slopes.shape, *rows.shape[1:]),
            rows[slopes.size : slopes.size + means.size].reshape(*means.shape, *rows.shape[1:]),
        )

    def band_rows(self, rows: Array) -> Array:
        """Those of the stacked rows (rows, ...) that the bands tell."""
        return rows[self.data.slopes.size + self.data.mean_v.size :]

    def _bands(self, z: Array) -> tuple[Array, Array]:
        """Residuals (R,) of what the bands tell of the response alone, and their derivatives (R, N), at values `z` (J,)
        of the nuisances."""
        bands, n = self.data.bands, 12 + len(z)
        if bands is None:
            return np.zeros(0), np.zeros((0, n))
        jacobian = np.zeros((len(bands.residual), n))
        jacobian[:, 12:] = bands.moves @ self.nuisances.response.T
        return bands.residual - bands.moves @ (z @ self.nuisances.response), jacobian


def _stack(data: Condensed, held: Sequence[Pose], response: Array, excited: Array | None) -> physics.Stack:
    """What the physics needs of condensed windows in these poses; `response` (K,) and one lag
    were taken out of all of them: none has its own lag taken out."""
    w, m = len(held), data.channels
    along, along_rate = np.tile(np.eye(m), (w, 1, 1)), np.zeros((w, m, m))
    for k, pose in enumerate(held):
        own = pose.direction.shape[1]
        if pose.along is not None:
            along[k, :own, :own] = pose.along
        if pose.along_rate_s is not None:
            along_rate[k, :own, :own] = pose.along_rate_s
    passed = np.zeros((w, TERMS, 2 * m, m))
    if data.bands is not None:
        passed[:, : data.bands.projected.shape[1]] = data.root[:, None] @ data.bands.projected
    return physics.Stack(
        direction=np.array([physics.padded(pose.direction, m) for pose in held]),
        gravity_mps2=np.array([pose.gravity_mps2 for pose in held]), along=along, along_rate_s=along_rate,
        excited=np.tile(np.eye(3) if excited is None else excited, (w, 1, 1)), root=data.root, slopes=data.slopes,
        passed=passed, omega2=data.omega2, u_lag_s=np.zeros(w), noise=data.type_a.noise, mean_x=data.mean_x,
        means=data.mean_v[:, None],
        over_t=np.tile(np.eye(1, 3), (w, 1, 1)), temperature_degc=np.full(w, np.nan), held_mps2=np.full((w, 3), np.nan),
        response=np.tile(np.pad(response, (0, TERMS - len(response))), (w, 1)),
    )  # fmt: skip
