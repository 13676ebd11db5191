"""The constant input acceleration at a fixed mount, and Q out of the mean output under it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calib.estimate.joint_state import JointState
from calib.estimate.linearised import Linearised
from calib.estimate.nuisances import Applied, Nuisances, Priors
from calib.estimate.terms import Term
from calib.estimate.window_rows import Summary
from calib.model import Array, Window

LEAST_TURN_MPS2 = 0.5  # between mean input accelerations: a mount that leans by 3 deg


def mean_input(window: Window) -> Array:
    """(3,) mean input acceleration of a window by its pose as stated; NaN where nobody stated gravity."""
    sums, pose = window.sums, window.pose
    mean = sums.count @ sums.mean[:, : pose.direction.shape[1]] / sums.count.sum()
    return np.asarray(pose.gravity_mps2 + pose.direction @ mean)


def never_turned(inputs: Array) -> bool:
    """Whether mean input accelerations (W, 3) are those of a mount that never turns against gravity.

    The means of V then tell Q + S G alone: they determine Q once S is known, and no part of S.
    """
    known = inputs[np.isfinite(inputs).all(axis=1)]
    return bool(len(known) and (np.linalg.norm(known - known[0], axis=1) <= LEAST_TURN_MPS2).all())


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """The constant input acceleration (3,) at a fixed mount, as stated, and how nuisances move it, by key (3,).

    `steady`: derivatives, by key, of the logarithm of the sensitivity at 0 Hz over S. `known_size`: the logarithm of S
    over the sensitivity at 0 Hz by the sensor's known filters.
    """

    mps2: Array
    by: Mapping[str, Array]
    steady: Mapping[str, float] = field(default_factory=dict)
    known_size: float = 0.0

    def parameters(self, state: JointState, joint: Array | None = None) -> tuple[Array, Array]:
        """S and Q (12,) and a factor (12, k) of their covariance, of a state with the mean output in the place of Q.

        `joint` (N, k) is a factor of the covariance of the state; None takes its own.
        """
        joint = state.factor if joint is None else joint
        mean, factor = state.mean[:12].copy(), joint[:12].copy()
        moving, moves = [state.index(key) for key in self.by], np.array([*self.by.values()]).reshape(-1, 3)
        terms, by_term = [state.index(key) for key in self.steady], np.array([*self.steady.values()])
        felt = self.mps2 + state.mean[moving] @ moves
        steady = float(np.exp(state.mean[terms] @ by_term - self.known_size))
        S = steady * mean[:9].reshape(3, 3)
        mean[9:] -= S @ felt
        factor[9:] -= steady * (felt @ factor[:9].reshape(3, 3, -1)) + (S @ moves.T) @ joint[moving]
        factor[9:] -= np.outer(S @ felt, by_term @ joint[terms])
        return mean, factor

    def mean_output_u(self, state: JointState, u_terms: Mapping[str, float]) -> Array:
        """(3,) standard uncertainty of the mean output before any data: of Q, S and what moves the input acceleration.

        `state` has Q itself; `u_terms` are standard uncertainties by key.
        """
        variance, S = state.variance, state.mean[:9].reshape(3, 3)
        felt = variance[9:12] + variance[:9].reshape(3, 3) @ self.mps2**2
        tilted = sum((S @ moves * u_terms[key]) ** 2 for key, moves in self.by.items())
        return np.sqrt(felt + tilted)

    def mount(self, joint: Linearised, terms: Sequence[Term], day: float) -> None:
        """The mean output takes the place of Q in a joint state on `day`; nuisances of the mount (`terms`) come in."""
        u = self.mean_output_u(joint.state, {term.key: joint.begun(term, day) for term in terms})
        for state in (joint.state, joint.base):
            S = state.mean[:9].reshape(3, 3)
            state.replace(slice(9, 12), state.mean[9:12] + S @ self.mps2, u)
        joint.point[9:12] = joint.state.mean[9:12]
        joint.append(terms, day)

    def unmount(self, joint: Linearised) -> None:
        """Q takes its place back; all windows must be in the base."""
        for state in (joint.state, joint.base):
            state.mean[:12], state.factor[:12] = self.parameters(state)
            state.stated_mean[9:12], state.stated_u[9:12] = state.mean[9:12], np.sqrt(state.variance[9:12])
            state.walked[9:12] = 0.0
        joint.point = joint.state.mean.copy()

    def with_gravity(self, ratio: float) -> Held:
        """The same mount with the stated gravity multiplied by `ratio`."""
        return replace(self, mps2=self.mps2 * ratio)

    def moved_by(self, other: Held, keys: Sequence[str]) -> Held:
        """The same acceleration, which nuisances with these keys move as `other` says."""
        return replace(self, by={**self.by, **{key: other.by[key] for key in keys if key in other.by}})

    def renamed(self, keys: Mapping[str, str]) -> Held:
        """The same with new keys of the quantities by the old ones."""
        by = {keys[key]: moves for key, moves in self.by.items()}
        return replace(self, by=by, steady={keys[key]: moves for key, moves in self.steady.items()})


def held_at(summary: Summary, priors: Priors) -> tuple[Held, Sequence[Term]]:
    """What a window's pose and its reference's mean tell of it; with all nuisances of that pose."""
    nuisances = Nuisances([summary.pose], summary.data.channels, priors, Applied(), summary.reference)
    inputs = nuisances.at(np.zeros(len(nuisances)))
    mean = summary.data.mean_x[0][: inputs.direction.shape[2]]
    moves = inputs.d_gravity[:, 0] + inputs.d_direction[:, 0] @ mean
    by = {t.key: m for t, m in zip(nuisances.terms, moves, strict=True) if np.any(m)}
    return Held(summary.held_mps2.copy(), by), nuisances.terms
