"""Mean and covariance of everything that is estimated together, by name; the covariance is kept as a factor.

P = L L', L (N, N): a product of a factor with itself cannot lose its sign, whatever the conditioning (square-root form
of the Kalman filter; Bierman 1977, ch. V).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.estimate.quantities import KINDS, Quantity
from calib.model import Array

ALIKE = 1e-10  # of unit vectors: directions of the factor closer than this are one


class JointState:
    """Quantities with their joint covariance, each under its name. Methods change it in place."""

    def __init__(self, quantities: Sequence[Quantity], mean: Array, standard_uncertainty: Array) -> None:
        self.quantities = list(quantities)
        self.names = [quantity.name for quantity in quantities]
        self.mean = np.array(mean, dtype=np.float64)
        self.factor = np.diag(np.asarray(standard_uncertainty, dtype=np.float64))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def covariance(self) -> Array:
        """(N, N)."""
        return np.asarray(self.factor @ self.factor.T)

    @property
    def variance(self) -> Array:
        """(N,) the diagonal of the covariance."""
        return np.asarray(np.einsum("ij,ij->i", self.factor, self.factor))

    def index(self, name: str) -> int:
        """Where a quantity stands. Raises ValueError where there is none of this name."""
        return self.names.index(name)

    def append(self, quantity: Quantity, mean: float, standard_uncertainty: float) -> None:
        """A quantity more, independent of all others."""
        n = len(self.names)
        grown = np.zeros((n + 1, n + 1))
        grown[:n, :n], grown[n, n] = self.factor, standard_uncertainty
        self.quantities.append(quantity)
        self.names.append(quantity.name)
        self.mean, self.factor = np.append(self.mean, mean), grown

    def keep(self, kept: Sequence[bool]) -> None:
        """Forget the others; what they did to the covariance of those kept stays (they are marginalised)."""
        keep = np.flatnonzero(kept)
        self.quantities = [self.quantities[k] for k in keep]
        self.names = [quantity.name for quantity in self.quantities]
        self.mean, self.factor = self.mean[keep], _square(self.factor[keep])

    def transform(self, matrix: Array) -> None:
        """x -> M x."""
        self.mean, self.factor = matrix @ self.mean, matrix @ self.factor

    def spread(self, variance: Array) -> None:
        """Add independent variance (N,) to the quantities."""
        live = np.flatnonzero(variance > 0.0)
        if live.size:
            noise = np.zeros((len(self), live.size))
            noise[live, range(live.size)] = np.sqrt(variance[live])
            self.factor = _square(np.hstack([self.factor, noise]))

    def replace(self, where: slice, mean: Array, covariance: Array) -> None:
        """Give some quantities this mean and covariance, independent of all others from now on."""
        self._replace(where, mean, np.zeros((len(mean), len(self))), covariance)

    def restate(self, where: slice, mean: Array, covariance: Array) -> None:
        """Give some quantities this mean and covariance; what they share with the others they go on sharing.

        Else a reference's error that is in them would count as a new one, and average out. Where they share more than
        `covariance` has room for, they keep that much.
        """
        others = np.delete(self.factor, where, axis=0)
        length = np.linalg.norm(others, axis=1)
        others = others[length > 0.0] / length[length > 0.0, None]
        shared = self.factor[where] @ np.linalg.pinv(others, rcond=ALIKE) @ others
        self._replace(where, mean, shared, covariance - shared @ shared.T)

    def _replace(self, where: slice, mean: Array, shared: Array, covariance: Array) -> None:
        """`shared` (k, N) is what is left of the factor's rows, `covariance` comes to it."""
        values, ways = np.linalg.eigh(covariance)
        own = np.zeros((len(self), len(mean)))
        own[where] = ways * np.sqrt(np.maximum(values, 0.0))
        self.mean[where], self.factor[where] = mean, shared
        self.factor = _square(np.hstack([self.factor, own]))

    def correct(self, step: Array, gain: Array, jacobian: Array) -> None:
        """x -> x + step, P -> (1 - K H) P (1 - K H)' + K K': for rows of unit covariance and any gain (Joseph)."""
        self.mean = self.mean + step
        self.factor = _square(np.hstack([self.factor - gain @ (jacobian @ self.factor), gain]))

    def copy(self) -> JointState:
        """An independent copy."""
        return JointState.load(self.snapshot())

    def snapshot(self) -> dict[str, Any]:
        """All of it, exactly."""
        quantities = [[q.name, q.kind.name, q.position] for q in self.quantities]
        return {"quantities": quantities, "mean": self.mean.copy(), "factor": self.factor.copy()}

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> JointState:
        """The state whose snapshot this is. Raises KeyError for a kind that the table of unknowns does not have."""
        quantities = [Quantity(name, KINDS[kind], position) for name, kind, position in state["quantities"]]
        loaded = cls(quantities, np.array(state["mean"]), np.zeros(len(quantities)))
        loaded.factor = np.array(state["factor"])
        return loaded


def _square(wide: Array) -> Array:
    """A square factor of the same product with itself."""
    return np.asarray(np.linalg.qr(wide.T, mode="r"), dtype=np.float64).T


def gain_of(jacobian: Array, factor: Array) -> Array:
    """(N, R) L A' (A A' + 1)^-1, A = H L: nothing larger than the rows is inverted, and the 1 bounds it."""
    a = jacobian @ factor
    return np.asarray(np.linalg.solve(a @ a.T + np.eye(len(a)), a @ factor.T).T)
