"""The window equations of the adjustment: the predicted slopes and means, and their derivatives by every unknown.

They follow from V = S a + Q (Eq. 8). For output axis i, with D and G of the pose (calib.estimate.nuisances) and the row
S_i of S,

    slope on u      S_i D (1 - lag_i^2 omega^2 / 2)
    slope on du/dt  -S_i D lag_i + S_i D' / omega
    mean of V       S_i (D mean(u) + G) + Q_i + S_i (D' / omega - lag_i D) mean(du/dt) + offset of the position

Where the response over frequency is an unknown, what is left of it adds to the slopes of each window
(calib.estimate.banded), and S is replaced by the sensitivity at 0 Hz.

The term in omega^2 = <du^2> / <u^2> is the projection of d2u/dt2 on u. It is exact for a sine, and for any motion after
the front end has removed the lag that was found, because the remaining lag is then negligible.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib.estimate.banded import Banded
from calib.estimate.condense import Condensed
from calib.estimate.never_turned import never_turned
from calib.estimate.nuisances import Inputs, Nuisances
from calib.estimate.slope_scatter import SlopeScatter
from calib.model import Array

# Least singular value of an excited direction, relative to the largest (columns scaled to one). It is 3e-6 for clamp
# positions of 0, 1 and 2 deg; rounding errors alone give 1e-15.
RANK_TOLERANCE = 1e-10
# Largest component of a parameter along a direction without excitation for which the parameter still counts as seen. A
# silent channel shares up to 1 % of another channel's motion (calib.excitation.excited). A direction without excitation
# is held at its scale, so u contains that component.
UNSEEN_SHARE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
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
    """The window equations of W condensed windows, with their poses and weights, as functions for Gauss-Newton."""

    def __init__(
        self,
        data: Condensed,
        nuisances: Nuisances,
        pose_of: list[int],
        offset_scatter_mps2: float,
        scatter: SlopeScatter,
        output_per_mps2: float | None = None,
        ways: Array | None = None,
    ) -> None:
        """`pose_of` (W,) is the number of each window's pose in `nuisances`. `offset_scatter_mps2` is the SD of the
        offset between windows, `scatter` that of the slopes. `output_per_mps2` is the sensor's scale in output unit per
        m/s2; None takes it from the data. `ways` (3, k), orthonormal: the directions that the windows excite; None:
        all. A nuisance turns the motion out of them, but what the slopes then show of S in other directions is of
        second order, and mostly noise: the slopes tell nothing of it.
        """
        self.data, self.nuisances, self.scatter = data, nuisances, scatter
        self.pose_of_window = np.array(pose_of)
        self._excited = None if ways is None or ways.shape[1] == len(ways) else ways @ ways.T
        self.known = known = nuisances.known[self.pose_of_window]
        self.output_per_mps2 = self._output_per_mps2() if output_per_mps2 is None else output_per_mps2
        noise2 = data.type_a.noise**2 / data.count[:, None]
        variance = noise2 + (offset_scatter_mps2 * self.output_per_mps2) ** 2
        # If gravity is not known in a pose, the mean has no information and gets no weight.
        self.mean_weight = np.where(known[:, None], 1.0 / np.sqrt(variance), 0.0)
        self.white_share = np.where(known[:, None], noise2 / variance, 0.0)

    @cached_property
    def unseen(self) -> Array:
        """Directions (k, 4) of (a_x, a_y, a_z, 1) normal to every input vector, with angles as stated. The rank is
        4 - k."""
        data, nuisances, m = self.data, self.nuisances, self.data.channels
        moved = np.einsum("brc,bkc->brk", data.root[:, :m, :m], nuisances.direction[self.pose_of_window])
        if self._excited is not None:
            moved = moved @ self._excited
        held = np.einsum("wkm,wm->wk", nuisances.mean_direction[self.pose_of_window], data.mean_x[:, :m])
        held, count = (held + nuisances.gravity[self.pose_of_window])[self.known], data.count[self.known]
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
        data, m = self.data, self.data.channels
        if self._excited is None:
            return np.zeros((3, 3))
        moved = np.einsum("brc,bkc->brk", data.root[:, :m, :m], self.nuisances.direction[self.pose_of_window])
        told, *_ = np.linalg.lstsq(
            (moved @ self._excited).reshape(-1, 3), data.slopes[:, :m].reshape(-1, 3), rcond=RANK_TOLERANCE
        )
        silent = np.eye(3) - self._excited
        outputs, _, ways = np.linalg.svd(told.T @ self._excited / self.output_per_mps2 + silent)
        return np.asarray(self.output_per_mps2 * outputs @ ways @ silent)

    def _output_per_mps2(self) -> float:
        """The sensor's scale in output unit per m/s2: rms of the outputs over rms of the inputs, slopes and means."""
        data, m = self.data, self.data.channels
        moved = np.einsum("brc,bkc->brk", data.root[:, :m, :m], self.nuisances.direction[self.pose_of_window])
        felt = np.einsum("wkm,wm->wk", self.nuisances.mean_direction[self.pose_of_window], data.mean_x[:, :m])
        gravity, n = (felt + self.nuisances.gravity[self.pose_of_window])[self.known], data.count[self.known]
        held, level = np.zeros((1, 3)), np.zeros((1, 3))
        if n.size:
            held = np.sqrt(n)[:, None] * (gravity - n @ gravity / n.sum())
            level = np.sqrt(n)[:, None] * (data.mean_v[self.known] - n @ data.mean_v[self.known] / n.sum())
        inputs = float((moved**2).sum() + (held**2).sum())
        outputs = float((data.slopes[:, :m] ** 2).sum() + (level**2).sum())
        return float(np.sqrt(outputs / inputs)) if inputs > 0.0 and outputs > 0.0 else 1.0

    def at(self, x: Array) -> Rows:
        """Residuals and derivatives at x = [S row by row, Q, nuisances] (N,)."""
        S, Q, z = x[:9].reshape(3, 3), x[9:12], x[12:]
        inputs = self.nuisances.at(z)
        # S is that at the reference frequency; the response is 1 at 0 Hz, where the sensitivity is this times S.
        steady, by_nuisance = self.nuisances.steady(z)
        slope, d_slope = self._slopes(steady * S, inputs)
        mean, d_mean = self._means(steady * S, Q, z, inputs)
        for moves in (d_slope, d_mean) if by_nuisance.any() else ():
            moves[..., :9] *= steady
            moves[..., 12:] += (moves[..., :9] @ x[:9])[..., None] * by_nuisance
        return Rows(slope, d_slope, mean, d_mean, *self._bands(inputs))

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

    def _slopes(self, S: Array, inputs: Inputs) -> tuple[Array, Array]:
        data, D, ahead = self.data, *(d[self.pose_of_window] for d in (inputs.direction, inputs.rate_direction))
        omega2 = data.omega2[:, None]
        on_u = 1.0 - 0.5 * inputs.lag_s**2 * omega2  # (W, 3)
        on_du = np.broadcast_to(-inputs.lag_s, on_u.shape)
        ideal = np.einsum("ik,bkm->bim", S, D)
        per_omega = np.divide(1.0, np.sqrt(omega2), out=np.zeros_like(omega2), where=omega2 > 0.0)
        across = inputs.quadrature[self.pose_of_window] * per_omega  # (W, 3), felt by the first channel's du/dt
        on_rate = ideal * on_du[..., None] + np.einsum("ik,bkm->bim", S, ahead)
        on_rate[:, :, :1] += (across @ S.T)[..., None]
        slopes = np.concatenate([ideal * on_u[..., None], on_rate], axis=2)  # (W, 3, 2M)
        if data.bands is not None:
            passed, d_passed = self._passed(data.bands, inputs)
            slopes += np.einsum("bim,brm->bir", ideal, passed)
        residual = data.slopes - np.einsum("brc,bic->bri", data.root, slopes)

        nuisances = self.nuisances
        d_ideal = np.einsum("ik,jbkm->bimj", S, inputs.d_direction[:, self.pose_of_window])
        d_on_u = -inputs.lag_s[:, None] * omega2[..., None] * nuisances.lag.T
        d_on_du = np.broadcast_to(-nuisances.lag.T, d_on_u.shape)
        d_on_rate = d_ideal * on_du[..., None, None] + ideal[..., None] * d_on_du[:, :, None, :]
        d_on_rate += np.einsum("ik,jbkm->bimj", S, inputs.d_rate_direction[:, self.pose_of_window])
        d_across = inputs.d_quadrature[:, self.pose_of_window] * per_omega
        d_on_rate[:, :, :1] += np.einsum("ik,jbk->bij", S, d_across)[:, :, None]
        d_z = np.concatenate(
            [d_ideal * on_u[..., None, None] + ideal[..., None] * d_on_u[:, :, None, :], d_on_rate], axis=2
        )
        if data.bands is not None:
            d_z += np.einsum("bimj,brm->birj", d_ideal, passed) + np.einsum("bim,jbrm->birj", ideal, d_passed)
        n = 12 + len(nuisances)
        jacobian = np.zeros((*data.slopes.shape, n))  # (W, 2M, 3, N)
        per_row = np.concatenate([D[:, None] * on_u[..., None, None], D[:, None] * on_du[..., None, None]], axis=3)
        if data.bands is not None:
            per_row += np.einsum("bkm,brm->bkr", D, passed)[:, None]
        per_row[:, :, :, D.shape[2] :] += ahead[:, None]
        per_row[:, :, :, D.shape[2] : D.shape[2] + 1] += across[:, None, :, None]
        if self._excited is not None:
            per_row = self._excited @ per_row
        for i in range(3):
            jacobian[:, :, i, 3 * i : 3 * i + 3] = np.einsum("brc,bkc->brk", data.root, per_row[:, i])
        jacobian[..., 12:] = np.einsum("brc,bicj->brij", data.root, d_z)
        noise = data.type_a.noise[:, None]
        return self._whitened(residual / noise), self._whitened(jacobian / noise[..., None])

    def _passed(self, bands: Banded, inputs: Inputs) -> tuple[Array, Array]:
        """What the response that is left adds to the slopes, (W, 2M, M), and its derivatives (J, W, 2M, M)."""
        terms = np.vstack([inputs.response, self.nuisances.response])
        passed = np.einsum("jk,bkrm->jbrm", terms, bands.projected)
        return passed[0], passed[1:]

    def _bands(self, inputs: Inputs) -> tuple[Array, Array]:
        """Residuals (R,) of what the bands tell of the response alone, and their derivatives (R, N)."""
        bands, n = self.data.bands, 12 + len(self.nuisances)
        if bands is None:
            return np.zeros(0), np.zeros((0, n))
        jacobian = np.zeros((len(bands.residual), n))
        jacobian[:, 12:] = bands.moves @ self.nuisances.response.T
        return bands.residual - bands.moves @ inputs.response, jacobian

    def _whitened(self, slopes: Array) -> Array:
        """Rows (W, 2M, 3, ...) weighted for the scatter between windows as well."""
        flat = slopes.reshape(len(slopes), -1, *slopes.shape[3:])
        return self.scatter.whiten(flat).reshape(slopes.shape)

    def _means(self, S: Array, Q: Array, z: Array, inputs: Inputs) -> tuple[Array, Array]:
        data, nuisances, m = self.data, self.nuisances, self.data.channels
        D = inputs.mean_direction[self.pose_of_window]
        moved = np.einsum("wkm,wm->wk", D, data.mean_x[:, :m])
        rate = np.einsum("wkm,wm->wk", D, data.mean_x[:, m:])
        G = inputs.gravity[self.pose_of_window]
        # If a window is no whole number of cycles, the mean of du/dt is not 0, and lag and quadrature add to the mean.
        per_omega = np.divide(1.0, np.sqrt(data.omega2), out=np.zeros_like(data.count), where=data.omega2 > 0.0)
        share = (data.mean_x[:, m] if m else 0.0 * data.count) * per_omega
        across = inputs.quadrature[self.pose_of_window] * share[:, None]
        felt = (moved + across + G)[:, None] - inputs.lag_s[:, None] * rate[:, None]  # (W, 3, 3): axis, direction
        predicted = np.einsum("ik,wik->wi", S, felt) + Q
        predicted += self.output_per_mps2 * np.einsum("j,jwi->wi", z, nuisances.offset[:, self.pose_of_window])
        jacobian = np.zeros((*data.mean_v.shape, 12 + len(nuisances)))
        for i in range(3):
            jacobian[:, i, 3 * i : 3 * i + 3] = felt[:, i]
            jacobian[:, i, 9 + i] = 1.0
        d_input = np.einsum("jwkm,wm->jwk", inputs.d_mean_direction[:, self.pose_of_window], data.mean_x[:, :m])
        d_input = d_input + inputs.d_gravity[:, self.pose_of_window]
        d_input = d_input + inputs.d_quadrature[:, self.pose_of_window] * share[:, None]
        jacobian[..., 12:] = np.einsum("ik,jwk->wij", S, d_input)
        jacobian[..., 12:] += self.output_per_mps2 * nuisances.offset[:, self.pose_of_window].transpose(1, 2, 0)
        jacobian[..., 12:] -= np.einsum("wi,ij->wij", rate @ S.T, nuisances.lag.T)
        return (data.mean_v - predicted) * self.mean_weight, jacobian * self.mean_weight[..., None]
