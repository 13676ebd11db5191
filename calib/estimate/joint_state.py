"""Mean and joint covariance of all quantities that are estimated together; the covariance is stored as a factor.

P = L L', L (N, N). A covariance computed from its factor cannot become negative, whatever its condition (square-root
form of the Kalman filter; Bierman 1977, ch. V).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.estimate.quantities import KINDS, Quantity
from calib.model import Array

ALIKE = 1e-10  # unit vectors of the factor that differ by less than this count as the same direction


class JointState:
    """Named quantities with their mean (N,) and joint covariance. The methods change the object in place."""

    def __init__(self, quantities: Sequence[Quantity], mean: Array, standard_uncertainty: Array) -> None:
        self.quantities = list(quantities)
        self.names = [quantity.name for quantity in quantities]
        self.mean = np.array(mean, dtype=np.float64)
        self.factor = np.diag(np.asarray(standard_uncertainty, dtype=np.float64))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def covariance(self) -> Array:
        """(N, N) joint covariance."""
        return np.asarray(self.factor @ self.factor.T)

    @property
    def variance(self) -> Array:
        """(N,) the diagonal of the covariance."""
        return np.asarray(np.einsum("ij,ij->i", self.factor, self.factor))

    def index(self, name: str) -> int:
        """Position of a quantity in the mean and the covariance. Raises ValueError if there is none of this name."""
        return self.names.index(name)

    def append(self, quantity: Quantity, mean: float, standard_uncertainty: float) -> None:
        """Add a quantity that is independent of all others."""
        n = len(self.names)
        grown = np.zeros((n + 1, n + 1))
        grown[:n, :n], grown[n, n] = self.factor, standard_uncertainty
        self.quantities.append(quantity)
        self.names.append(quantity.name)
        self.mean, self.factor = np.append(self.mean, mean), grown

    def keep(self, kept: Sequence[bool]) -> None:
        """Remove the other quantities (marginalise them): mean and covariance of those kept do not change."""
        keep = np.flatnonzero(kept)
        self.quantities = [self.quantities[k] for k in keep]
        self.names = [quantity.name for quantity in self.quantities]
        self.mean, self.factor = self.mean[keep], _square(self.factor[keep])

    def transform(self, matrix: Array) -> None:
        """Replace x by M x, and the covariance P by M P M'."""
        self.mean, self.factor = matrix @ self.mean, matrix @ self.factor

    def spread(self, variance: Array) -> None:
        """Add independent variances (N,) to those of the quantities."""
        live = np.flatnonzero(variance > 0.0)
        if live.size:
            noise = np.zeros((len(self), live.size))
            noise[live, range(live.size)] = np.sqrt(variance[live])
            self.factor = _square(np.hstack([self.factor, noise]))

    def replace(self, where: slice, mean: Array, covariance: Array) -> None:
        """Give the quantities `where` this mean (k,) and covariance (k, k), independent of all other quantities."""
        self._replace(where, mean, np.zeros((len(mean), len(self))), covariance)

    def restate(self, where: slice, mean: Array, covariance: Array) -> None:
        """Give the quantities `where` this mean (k,) and covariance (k, k), and keep their covariance with the others.

        Without that covariance an error of the reference would count as a new, independent error, and average out. If
        the common part is larger than `covariance` allows, the common part stays and the covariance becomes larger.
        """
        others = np.delete(self.factor, where, axis=0)
        length = np.linalg.norm(others, axis=1)
        others = others[length > 0.0] / length[length > 0.0, None]
        shared = self.factor[where] @ np.linalg.pinv(others, rcond=ALIKE) @ others
        self._replace(where, mean, shared, covariance - shared @ shared.T)

    def _replace(self, where: slice, mean: Array, shared: Array, covariance: Array) -> None:
        """`shared` (k, N) replaces the rows of the factor; `covariance` (k, k) is added to it as independent."""
        values, ways = np.linalg.eigh(covariance)
        own = np.zeros((len(self), len(mean)))
        own[where] = ways * np.sqrt(np.maximum(values, 0.0))
        self.mean[where], self.factor[where] = mean, shared
        self.factor = _square(np.hstack([self.factor, own]))

    def correct(self, step: Array, gain: Array, jacobian: Array) -> None:
        """Measurement update: x + step replaces x, and (1 - K H) P (1 - K H)' + K K' replaces P.

        This is Joseph's form for rows of unit covariance; it is right for any gain K. `step` (N,), `gain` K (N, k),
        `jacobian` H (k, N).
        """
        self.mean = self.mean + step
        self.factor = _square(np.hstack([self.factor - gain @ (jacobian @ self.factor), gain]))

    def copy(self) -> JointState:
        """An independent copy."""
        return JointState.load(self.snapshot())

    def snapshot(self) -> dict[str, Any]:
        """The complete state, for `load`; bit for bit."""
        quantities = [[q.name, q.kind.name, q.position] for q in self.quantities]
        return {"quantities": quantities, "mean": self.mean.copy(), "factor": self.factor.copy()}

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> JointState:
        """The state whose snapshot this is. Raises KeyError if the table of unknowns does not have one of its kinds."""
        quantities = [Quantity(name, KINDS[kind], position) for name, kind, position in state["quantities"]]
        loaded = cls(quantities, np.array(state["mean"]), np.zeros(len(quantities)))
        loaded.factor = np.array(state["factor"])
        return loaded


def _square(wide: Array) -> Array:
    """The square factor with the same product L L' as `wide`."""
    return np.asarray(np.linalg.qr(wide.T, mode="r"), dtype=np.float64).T


def gain_of(jacobian: Array, factor: Array) -> Array:
    """Kalman gain (N, k) = L A' (A A' + 1)^-1 with A = H L, for k rows H (k, N) with unit noise and the factor L.

    Only a (k, k) matrix is inverted, and none of its eigenvalues is below 1.
    """
    a = jacobian @ factor
    return np.asarray(np.linalg.solve(a @ a.T + np.eye(len(a)), a @ factor.T).T)
