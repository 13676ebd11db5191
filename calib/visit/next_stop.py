"""The next stop: which position of the sensor reduces the uncertainty of S most, by the joint covariance.

A stop is a position that can be taken next. What its window will tell follows from the pose, the motion and the noise
alone, so that the covariance after it is known before it was taken. S, Q and the nuisances that positions share (theta,
gravity, ...) are one joint state; the nuisances of one position (its alpha, its offset) are in it once it was taken.

The reference's own error is left out: no position reduces it, and it is the same for every main sensitivity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.adjustment.adjustment import Adjustment
from calib.estimate.nuisances import Applied, Priors
from calib.estimate.physics import STEP
from calib.estimate.quantities import REFERENCE, REFERENCE_DRIFT, S_AND_Q, Quantity
from calib.estimate.terms import Nuisances
from calib.model import Array, Pose, Window
from calib.windows.sums import pool

COVERAGE_FACTOR = 2.0
MAIN = np.eye(3, dtype=bool).ravel()
# Power of U over its limit, summed over S to compare stops. The sum of squares also values what is not the worst yet,
# but may trade a wanted U for one that is reached already; a large power sees the worst alone, which one stop cannot
# always reduce.
POWER = 4.0
# Standard uncertainties before the first stop, relative to the sensitivity and in m/s2. They are so large that they
# change nothing after four stops, and small enough that a difference of covariances keeps its digits.
U_SENSITIVITY, U_OFFSET_MPS2 = 0.3, 20.0
MANY = 1e4  # visits of every stop: what is left then does not become less
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class WantedUncertainty:
    """The expanded uncertainties (k = 2) that are wanted, relative to the main sensitivity."""

    main: float = 5e-4
    transverse: float = 2.5e-3

    @property
    def by_parameter(self) -> Array:
        """(9,) row by row."""
        return np.where(MAIN, self.main, self.transverse)

    def reached(self, expanded: Array) -> bool:
        """Whether expanded uncertainties (9,) are all as wanted."""
        return bool(np.all(expanded <= self.by_parameter))

    def cost(self, expanded: Array) -> Array:
        """(...,) how far expanded uncertainties (..., 9) are from what is wanted."""
        return np.asarray(np.sum((expanded / self.by_parameter) ** POWER, axis=-1))


@dataclass(frozen=True, slots=True)
class Expected:
    """What a window is expected to hold: rms of the motion, noise of the sensor, independent points.

    `rms_mps2` is 0 for rests. `noise_mps2` is the SD of one point.
    """

    rms_mps2: float
    noise_mps2: float
    points: float

    def longer(self, times: float) -> Expected:
        """The same of a stay that is so many times as long."""
        return replace(self, points=times * self.points)


@dataclass(frozen=True, slots=True, eq=False)
class JointCovariance:
    """What is known of S, Q and the nuisances: `quantities` (N), `mean` (N,), `covariance` (N, N).

    `scale` is the output unit per m/s2.
    """

    quantities: tuple[str, ...]
    mean: Array
    covariance: Array
    scale: float

    @classmethod
    def before(cls, priors: Priors, scale: float = 1.0) -> JointCovariance:
        """Before the first stop. `scale`: the nominal sensitivity, where `priors` have no S."""
        u = scale * np.append(np.full(9, U_SENSITIVITY), np.full(3, U_OFFSET_MPS2))
        mean, covariance = scale * np.append(np.eye(3).ravel(), np.zeros(3)), np.diag(u**2)
        if priors.parameters is not None and priors.covariance is not None:
            known = np.flatnonzero(np.isfinite(priors.parameters) & (np.diag(priors.covariance) < u**2))
            mean[known] = priors.parameters[known]
            covariance[np.ix_(known, known)] = priors.covariance[np.ix_(known, known)]
        return cls(tuple(q.key for q in S_AND_Q), mean, covariance, scale)

    @classmethod
    def after(cls, found: Adjustment) -> JointCovariance:
        """After an adjustment, given the reference as it is."""
        names = [*(q.key for q in S_AND_Q), *(Quantity(n.name, n.kind).key for n in found.nuisances)]
        own = np.array([False] * 12 + [n.kind in (REFERENCE, REFERENCE_DRIFT) for n in found.nuisances])
        scale = float(np.sqrt(np.mean(found.mean[[0, 4, 8]] ** 2)))
        return cls(tuple(names), found.mean, found.covariance, scale)._conditional(own)

    def _conditional(self, known: Flags) -> JointCovariance:
        """The same if the quantities `known` (N,) were exact."""
        rest = ~known
        shared = self.covariance[np.ix_(rest, known)]
        told = np.linalg.solve(self.covariance[np.ix_(known, known)], shared.T)
        names = tuple(name for name, left in zip(self.quantities, rest, strict=True) if left)
        return replace(
            self, quantities=names, mean=self.mean[rest],
            covariance=self.covariance[np.ix_(rest, rest)] - shared @ told,
        )  # fmt: skip

    @property
    def main(self) -> Array:
        """(9,) the main sensitivity of the row that each element of S belongs to."""
        return np.repeat(np.abs(self.mean[[0, 4, 8]]), 3)

    @property
    def expanded(self) -> Array:
        """(9,) expanded uncertainties of S, relative to the main sensitivity of the row."""
        return np.asarray(COVERAGE_FACTOR * np.sqrt(np.diag(self.covariance)[:9]) / self.main)


@dataclass(frozen=True, slots=True, eq=False)
class Suggestion:
    """A stop with the expanded uncertainties (9,) that S will have after it."""

    stop: int
    expanded: Array

    @property
    def main(self) -> float:
        """The worst of the main sensitivities, relative."""
        return float(self.expanded[MAIN].max())

    @property
    def transverse(self) -> float:
        """The worst of the transverse sensitivities, relative."""
        return float(self.expanded[~MAIN].max())


@dataclass(frozen=True, slots=True, eq=False)
class StopIndications:
    """What the window of a stop told: `slopes` (3, m) output over motion, `mean` (3,) output without motion.

    `reference_mps2` (m,): the mean of the reference, by which it feels gravity.
    """

    slopes: Array
    mean: Array
    reference_mps2: Array

    @classmethod
    def of(cls, window: Window) -> StopIndications:
        """Of a window with m channels, by a regression of its sums on the motion and its derivative."""
        m, whole = window.sums.reference_channels, pool(window.sums)
        scatter, mean = whole.scatter[0], whole.mean[0]
        if window.kind == "rest":
            return cls(np.zeros((3, m)), mean[2 * m :], mean[:m])
        slopes = np.linalg.lstsq(scatter[: 2 * m, : 2 * m], scatter[: 2 * m, 2 * m :], rcond=None)[0].T
        return cls(slopes[:, :m], mean[2 * m :] - slopes @ mean[: 2 * m], np.zeros(m))


class Plan:
    """The stops that can be taken, P poses, and what each would tell."""

    def __init__(self, poses: Sequence[Pose], priors: Priors, reference_mps2: Array | None = None) -> None:
        """`reference_mps2` (P, m): the means that the reference will show, 0 for one that does not feel gravity.

        All poses have the same number m of channels.
        """
        self.poses = tuple(poses)
        channels = poses[0].direction.shape[1]
        given = priors.with_values({"reference": 0.0, "reference_drift": 0.0})
        nuisances = Nuisances(poses, channels, given, Applied())
        mean = np.zeros((len(poses), channels)) if reference_mps2 is None else np.asarray(reference_mps2)
        self._names = [t.key for t in nuisances.terms]
        self._u = nuisances.uncertainty
        # Terms (J, P) that a pose has: the common ones and its own.
        self._own = np.array([[t.quantity.position in ("", p.position) for p in poses] for t in nuisances.terms])
        self._own = self._own.reshape(len(nuisances), len(poses))
        self._common = np.array([t.quantity.position == "" for t in nuisances.terms], dtype=bool)
        self._offset_u = given.offset_mps2
        # (P, 3, m + 1) inputs per unit motion of each channel, then of the mean; derivatives (J, P, 3, m + 1).
        # The mean is felt with the sensitivity at 0 Hz, the motion with that at its frequency.
        z = np.vstack([np.zeros(len(nuisances)), 1j * STEP * np.eye(len(nuisances))])
        at = nuisances.at(z)
        steady = nuisances.steady(z)[:, None, None] * (at.gravity + (at.direction @ mean[..., None])[..., 0])
        felt = np.concatenate([at.direction, steady[..., None]], axis=3)
        self._felt, self._d_felt = felt[0].real, felt[1:].imag / STEP
        self._offset = at.offset[1:].imag / STEP

    def after(self, joint: JointCovariance, stop: int, expected: Expected) -> JointCovariance:
        """What is known after this stop."""
        joint = self._with(joint, self._own[:, stop])
        rows, noise = self._rows(joint, expected, [stop])
        gain = _gain(joint.covariance, rows, noise)
        return replace(joint, covariance=joint.covariance - (gain @ rows @ joint.covariance)[0])

    def shared(self, joint: JointCovariance) -> JointCovariance:
        """The same with every quantity that all positions share, also before the first stop.

        What several stops tell together depends on it: an error that they share does not average out.
        """
        return self._with(joint, self._common)

    def _with(self, joint: JointCovariance, needed: Flags) -> JointCovariance:
        """The same with the `needed` ones of all nuisances (J,), as they are known beforehand."""
        new = [j for j in np.flatnonzero(needed) if self._names[j] not in joint.quantities]
        n, more = len(joint.quantities), len(new)
        covariance = np.zeros((n + more, n + more))
        covariance[:n, :n] = joint.covariance
        covariance[range(n, n + more), range(n, n + more)] = self._u[new] ** 2
        names = joint.quantities + tuple(self._names[j] for j in new)
        return JointCovariance(names, np.append(joint.mean, np.zeros(more)), covariance, joint.scale)

    def suggestions(self, joint: JointCovariance, expected: Expected, wanted: WantedUncertainty) -> list[Suggestion]:
        """All stops, the one that brings S nearest to what is wanted first."""
        every = list(range(len(self.poses)))
        rows, noise = self._rows(joint, expected, every)
        gain = _gain(joint.covariance, rows, noise)
        less = np.einsum("pkr,prk->pk", gain[:, :9], rows @ joint.covariance[:, :9])
        variance = np.maximum(np.diag(joint.covariance)[:9] - less, 0.0)
        expanded = COVERAGE_FACTOR * np.sqrt(variance) / joint.main
        order = np.argsort(wanted.cost(expanded), kind="stable")
        return [Suggestion(int(p), expanded[p]) for p in order]

    def surprise(self, joint: JointCovariance, told: StopIndications, expected: Expected) -> Array:
        """(P,) how badly what a window told fits each of the stops: chi2, with 3 (m + 1) degrees of freedom.

        Beside a reference that feels gravity, the reference tells how the sensor stands, and all stops fit alike.
        """
        every = list(range(len(self.poses)))
        rows, noise = self._rows(joint, expected, every)
        weight = np.append(np.full(told.slopes.shape[1], expected.rms_mps2), 1.0)
        measured = np.column_stack([told.slopes, told.mean]) * weight
        known = joint.mean.copy()
        known[:9] = 0.0  # the rows of S are linear in S as well: S is counted once, with the inputs
        S = joint.mean[:9].reshape(3, 3)
        felt = self._felt * weight
        if told.reference_mps2.any():
            felt[:, :, -1] = self.poses[0].direction @ told.reference_mps2
        off = (measured - S @ felt).reshape(len(every), -1) - rows @ known
        spread = rows @ joint.covariance @ rows.transpose(0, 2, 1) + noise
        return np.asarray(np.einsum("pr,pr->p", off, np.linalg.solve(spread, off[..., None])[..., 0]))

    def floor(self, joint: JointCovariance, expected: Expected) -> tuple[Array, dict[str, Array]]:
        """The expanded uncertainties (9,) after any number of stops, each taken anew and with errors of its own.

        And what they would be if a quantity that all positions share were exact, by its name.
        """
        start = self.shared(joint)
        kept = np.isin(start.quantities, [q.key for q in S_AND_Q] + list(np.array(self._names)[self._common]))
        start = JointCovariance(
            tuple(name for name, keep in zip(start.quantities, kept, strict=True) if keep),
            start.mean[kept], start.covariance[np.ix_(kept, kept)], start.scale,
        )  # fmt: skip
        told = MANY * self.information(start, expected).sum(axis=0)

        def left(known: str) -> Array:
            free = np.array([name != known for name in start.quantities])
            given = start if known == "" else start._conditional(~free)
            scale = np.sqrt(np.diag(given.covariance))
            precision = np.linalg.inv(given.covariance / np.outer(scale, scale))
            information = precision + told[np.ix_(free, free)] * np.outer(scale, scale)
            return replace(given, covariance=np.linalg.inv(information) * np.outer(scale, scale)).expanded

        return left(""), {name: left(name) for name in start.quantities[12:]}

    def information(self, joint: JointCovariance, expected: Expected) -> Array:
        """(P, N, N) what each stop would add to the inverse of the covariance.

        Stops of the same position are taken to have errors of their own, unless the position was taken before.
        """
        rows, noise = self._rows(joint, expected, list(range(len(self.poses))))
        return np.asarray(rows.transpose(0, 2, 1) @ np.linalg.solve(noise, rows))

    def _rows(self, joint: JointCovariance, expected: Expected, stops: list[int]) -> tuple[Array, Array]:
        """Rows (P, 3 (m + 1), N) of the windows of these stops, and the covariances of their noise.

        A nuisance of a position that is not in the joint state is part of the noise.
        """
        S, size = joint.mean[:9].reshape(3, 3), self._felt.shape[2]
        weight = np.append(np.full(size - 1, expected.rms_mps2), 1.0)
        felt, d_felt = self._felt[stops] * weight, self._d_felt[:, stops] * weight
        rows = np.zeros((len(stops), 3, size, len(joint.quantities)))
        for i in range(3):
            rows[:, i, :, 3 * i : 3 * i + 3] = felt.transpose(0, 2, 1)
            rows[:, i, -1, 9 + i] = 1.0
        moved = np.einsum("ik,jpkr->jpir", S, d_felt)
        moved[..., -1] += joint.scale * self._offset[:, stops]
        moved *= self._own[:, stops, None, None]
        white = joint.scale * expected.noise_mps2 / np.sqrt(expected.points)
        u = np.full((3, size), white)
        u[:, -1] = np.hypot(white, joint.scale * self._offset_u)
        noise = np.tile(np.diag(u.ravel() ** 2), (len(stops), 1, 1))
        place = {name: k for k, name in enumerate(joint.quantities)}
        for j in [j for j, name in enumerate(self._names) if name in place]:
            rows[..., place[self._names[j]]] = moved[j]
        new = [j for j, name in enumerate(self._names) if name not in place]
        one = self._u[new, None, None] * moved[new].reshape(len(new), len(stops), 3 * size)
        noise += np.einsum("jpr,jps->prs", one, one, optimize=True)
        return rows.reshape(len(stops), 3 * size, -1), noise


def _gain(covariance: Array, rows: Array, noise: Array) -> Array:
    """Gains (P, N, R) of a Kalman update with rows (P, R, N) and the covariances (P, R, R) of their noise."""
    shared = rows @ covariance  # (P, R, N)
    return np.asarray(np.linalg.solve(shared @ rows.transpose(0, 2, 1) + noise, shared).transpose(0, 2, 1))
