"""Mean and joint covariance of all quantities that are estimated together; the covariance is stored as a factor.

P = L L', L (N, N). A covariance computed from its factor cannot become negative, whatever its condition (square-root
form of the Kalman filter; Bierman 1977, ch. V).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.estimate.quantities import KINDS, Quantity
from calib.model import Array

UNKNOWN_CORRELATION = 2.0  # by which variances grow where a correlation was lost


class JointState:
    """Quantities with their mean (N,) and joint covariance. The methods change the object in place.

    `stated_mean`, `stated_u` (N,): the prior of each quantity, with which it came into the state; `exchange` replaces
    it. `walked` (N,): the variance that random walks and loosening have added to the quantity since then. `doubt`: the
    factor by which the variance of a new quantity is larger than its prior, because a correlation was lost before.
    """

    def __init__(self, quantities: Sequence[Quantity], mean: Array, standard_uncertainty: Array) -> None:
        self.quantities = list(quantities)
        self.mean = np.array(mean, dtype=np.float64)
        self.factor = np.diag(np.asarray(standard_uncertainty, dtype=np.float64))
        self.stated_mean = self.mean.copy()
        self.stated_u = np.array(standard_uncertainty, dtype=np.float64)
        self.walked = np.zeros(len(self.mean))
        self.doubt = 1.0
        self._rename()

    def _rename(self) -> None:
        self.keys = [quantity.key for quantity in self.quantities]
        self._at = {key: k for k, key in enumerate(self.keys)}

    def __len__(self) -> int:
        return len(self.quantities)

    def __contains__(self, key: str) -> bool:
        return key in self._at

    @property
    def covariance(self) -> Array:
        """(N, N) joint covariance."""
        return np.asarray(self.factor @ self.factor.T)

    @property
    def variance(self) -> Array:
        """(N,) the diagonal of the covariance."""
        return np.asarray(np.einsum("ij,ij->i", self.factor, self.factor))

    def index(self, key: str) -> int:
        """Position of a quantity in the mean and the covariance. Raises KeyError if there is none with this key."""
        return self._at[key]

    def append(self, quantity: Quantity, mean: float, standard_uncertainty: float) -> None:
        """Add a quantity that is independent of all others, with its prior."""
        row = np.append(np.zeros(len(self)), standard_uncertainty * np.sqrt(self.doubt))
        self._grow(quantity, mean, row, mean, standard_uncertainty, (self.doubt - 1.0) * standard_uncertainty**2)

    def append_first(self, k: int) -> None:
        """Add the value that quantity `k` has now, which stays when the quantity changes."""
        row = np.append(self.factor[k], 0.0)
        first = replace(self.quantities[k], first=True)
        self._grow(first, self.mean[k], row, self.stated_mean[k], self.stated_u[k], self.walked[k])

    def _grow(
        self, quantity: Quantity, mean: float, row: Array, stated_mean: float, stated_u: float, walked: float
    ) -> None:
        """Add a quantity; `row` (N + 1,) is its row of the factor."""
        n = len(self)
        grown = np.zeros((n + 1, n + 1))
        grown[:n, :n], grown[n] = self.factor, row
        self.quantities.append(quantity)
        self.mean, self.factor = np.append(self.mean, mean), grown
        self.stated_mean, self.stated_u = np.append(self.stated_mean, stated_mean), np.append(self.stated_u, stated_u)
        self.walked = np.append(self.walked, walked)
        self._rename()

    def keep(self, kept: Sequence[bool]) -> None:
        """Remove the other quantities (marginalise them): mean and covariance of those kept do not change."""
        keep = np.flatnonzero(kept)
        self.quantities = [self.quantities[k] for k in keep]
        self.mean, self.factor = self.mean[keep], _square(self.factor[keep])
        self.stated_mean, self.stated_u = self.stated_mean[keep], self.stated_u[keep]
        self.walked = self.walked[keep]
        self._rename()

    def hand_over(self, owner: str, new_owner: str, *, of_place: bool = False) -> None:
        """Give the quantities of an owner another owner; with `of_place` only those of its place (see `Kind.of_place`).

        What the new owner has already, stays.
        """
        for k, quantity in enumerate(self.quantities):
            handed = replace(quantity, owner=new_owner)
            if quantity.owner == owner and (quantity.kind.of_place or not of_place) and handed.key not in self:
                self.quantities[k] = handed
        self._rename()

    def transform(self, matrix: Array) -> None:
        """Replace x by M x, and the covariance P by M P M'."""
        self.mean, self.factor = matrix @ self.mean, matrix @ self.factor

    def spread(self, variance: Array) -> None:
        """Add independent variances (N,) to those of the quantities."""
        self.walked = self.walked + variance
        live = np.flatnonzero(variance > 0.0)
        if live.size:
            noise = np.zeros((len(self), live.size))
            noise[live, range(live.size)] = np.sqrt(variance[live])
            self.factor = _square(np.hstack([self.factor, noise]))

    def suspect(self, change: Array) -> None:
        """Add the covariance of one change of all quantities together, whose standard deviation is `change` (N,)."""
        self.walked = self.walked + change**2
        self.factor = _square(np.hstack([self.factor, change[:, None]]))

    def replace(self, where: slice, mean: Array, standard_uncertainty: Array) -> None:
        """Give the quantities `where` this prior (k,), (k,), independent of all other quantities."""
        own = np.zeros((len(self), len(mean)))
        own[where] = np.diag(standard_uncertainty)
        self.mean[where], self.factor[where] = mean, 0.0
        self.factor = _square(np.hstack([self.factor, own]))
        self.stated_mean[where], self.stated_u[where], self.walked[where] = mean, standard_uncertainty, 0.0

    def intersect(self, where: slice, mean: Array, covariance: Array) -> None:
        """Give the quantities `where` this mean (k,) and covariance (k, k), whose correlation with the other quantities
        is not known.

        Both blocks of the covariance are doubled, and those of later quantities. That is covariance intersection with
        equal weights (Julier and Uhlmann 1997): the joint covariance is not too small, whatever the correlation is.
        """
        self.walked = self.walked + (UNKNOWN_CORRELATION - 1.0) * self.variance
        self.doubt = UNKNOWN_CORRELATION
        values, ways = np.linalg.eigh(covariance)
        own = np.zeros((len(self), len(mean)))
        own[where] = ways * np.sqrt(np.maximum(values, 0.0))
        self.mean[where], self.factor[where] = mean, 0.0
        self.factor = np.sqrt(UNKNOWN_CORRELATION) * _square(np.hstack([self.factor, own]))

    def shift(self, k: int, factor: float, amount: float) -> None:
        """State a quantity against another zero: factor x + amount replaces x, in its prior too."""
        for values in (self.mean, self.stated_mean):
            values[k] = factor * values[k] + amount
        self.factor[k] *= factor
        self.stated_u[k] *= factor
        self.walked[k] *= factor**2

    def exchange(self, k: int, mean: float, standard_uncertainty: float) -> None:
        """Replace the prior of one quantity, with which it came into the state, by another prior.

        In information form this adds 1/u1^2 - 1/u0^2, and the matching vector. For a constant quantity that is exact.
        Of a nuisance that walked or was loosened, the first value is exchanged (see `append_first`). S and Q have none:
        if x has walked by the variance W, its first value b has, given x, the mean m0 + c (x - m0) and the variance
        c W, c = u0^2 / (u0^2 + W); that is exact if the data are newer than the walk. Raises ValueError if the quantity
        had no uncertainty, because then the state does not have its effect.
        """
        m0, p0, p1 = self.stated_mean[k], self.stated_u[k] ** 2, standard_uncertainty**2
        if p0 == 0.0:
            raise ValueError(f"{self.keys[k]} had no uncertainty, so the state does not have its effect")
        share = p0 / (p0 + self.walked[k])
        row = share * self.factor[k]
        length2 = float(row @ row)
        # All is multiplied by u1^2, so that u1 may be 0.
        gained = 1.0 - p1 / p0
        spread = p1 + gained * (length2 + share * self.walked[k])
        told = mean - m0 * p1 / p0 - gained * (m0 + share * (self.mean[k] - m0))
        along = self.factor @ row
        if length2 > 0.0:
            self.mean = self.mean + along * (told / spread)
            part = min(gained * length2 / spread, 1.0)
            self.factor = self.factor - np.outer(along, row) * ((1.0 - np.sqrt(1.0 - part)) / length2)
        self.stated_mean[k], self.stated_u[k] = mean, standard_uncertainty

    def correct(self, step: Array, gain: Array, jacobian: Array) -> None:
        """Measurement update: x + step replaces x, and (1 - K H) P (1 - K H)' + K K' replaces P.

        This is Joseph's form for rows of unit covariance; it is right for any gain K. `step` (N,), `gain` K (N, k),
        `jacobian` H (k, N).
        """
        self.mean = self.mean + step
        self.factor = _square(np.hstack([self.factor - gain @ (jacobian @ self.factor), gain]))

    def copy(self) -> JointState:
        """An independent copy."""
        other = object.__new__(JointState)
        other.__dict__.update(self.__dict__)
        other.quantities = list(self.quantities)  # names and keys are never changed, only replaced
        for name in _ARRAYS:
            setattr(other, name, getattr(self, name).copy())
        return other

    def snapshot(self) -> dict[str, Any]:
        """The complete state, for `load`; bit for bit."""
        quantities = [[q.name, q.kind.name, q.position, q.owner, q.first] for q in self.quantities]
        arrays = {name: getattr(self, name).copy() for name in _ARRAYS}
        return {"quantities": quantities, "doubt": self.doubt} | arrays

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> JointState:
        """The state whose snapshot this is. Raises KeyError if the table of unknowns does not have one of its kinds."""
        quantities = [Quantity(name, KINDS[kind], *rest) for name, kind, *rest in state["quantities"]]
        loaded = cls(quantities, np.array(state["mean"]), np.zeros(len(quantities)))
        for name in _ARRAYS:
            setattr(loaded, name, np.array(state[name]))
        loaded.doubt = state["doubt"]
        return loaded


_ARRAYS = ("mean", "factor", "stated_mean", "stated_u", "walked")


def _square(wide: Array) -> Array:
    """The square factor with the same product L L' as `wide`."""
    factor = np.asarray(np.linalg.qr(wide.T, mode="r"), dtype=np.float64)
    return np.ascontiguousarray(factor.T)


def gain_of(jacobian: Array, factor: Array) -> Array:
    """Kalman gain (N, k) = L A' (A A' + 1)^-1 with A = H L, for k rows H (k, N) with unit noise and the factor L.

    Only a (k, k) matrix is inverted, and none of its eigenvalues is below 1.
    """
    a = jacobian @ factor
    return np.asarray(np.linalg.solve(a @ a.T + np.eye(len(a)), a @ factor.T).T)
