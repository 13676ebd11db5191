"""GUM propagation for methods that solve nothing for their nuisances: what each one would do to the result.

A method is described by its response: what it would give on a sensor of known S and Q where the inputs are moved by a
nuisance and the method does not know. The nuisances and their priors are those of the adjustment (calib.estimate).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.distributions import coverage_factor
from calib.estimate.nuisances import Inputs, Nuisances
from calib.model import Array

Response = Callable[[Inputs, Array], Array]
"""(inputs, offset (P, 3) in m/s2) -> (12,) as calib.model.PARAMETERS, NaN what the method does not give."""


@dataclass(frozen=True, slots=True, eq=False)
class Contribution:
    """What one standard uncertainty of a nuisance does to the 12 parameters, signed, in their units."""

    source: str
    change: Array


@dataclass(frozen=True, slots=True, eq=False)
class Statement:
    """The uncertainty of one method's result: type B contributions by nuisance, and the type A part.

    `u_type_a` and `freedom_type_a` (12,). NaN marks parameters that the method does not give.
    """

    contributions: Mapping[str, Contribution]
    u_type_a: Array
    freedom_type_a: Array

    @property
    def covariance(self) -> Array:
        """(12, 12) combined."""
        return joint_covariance([self])

    @property
    def by_source(self) -> dict[str, Array]:
        """{source: (12,) standard uncertainty}, type A included; their squares add up to the combined one's."""
        squares = {"type A": self.u_type_a**2}
        for contribution in self.contributions.values():
            squares[contribution.source] = squares.get(contribution.source, 0.0) + contribution.change**2
        return {source: np.sqrt(square) for source, square in squares.items()}

    @property
    def coverage_factor(self) -> float:
        """k for 95.45 %, by the parameter with the fewest effective degrees of freedom (Welch-Satterthwaite)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            effective = np.diag(self.covariance) ** 2 / (self.u_type_a**4 / self.freedom_type_a)
        return coverage_factor(float(np.nanmin(effective, initial=np.inf)))


def propagate(response: Response, nuisances: Nuisances) -> dict[str, Contribution]:
    """Contributions of all nuisances, each moved by plus and minus its standard uncertainty.

    The second order is a contribution of its own: for a normal nuisance z of variance u2 the term f'' z2 / 2 has mean
    f'' u2 / 2, which the methods do not correct, and SD f'' u2 / sqrt(2) (GUM 5.1.2, note): together sqrt(3)/2 f'' u2.
    It is all there is where a direction is met squarely, as in Method 1.
    """
    none = np.zeros(len(nuisances))
    before = response(nuisances.at(none), _offset(nuisances, none))
    found: dict[str, Contribution] = {}
    for term, one in zip(nuisances.terms, np.diag(nuisances.uncertainty), strict=True):
        up, down = (response(nuisances.at(z), _offset(nuisances, z)) for z in (one, -one))
        parts = {term.name: (up - down) / 2, f"{term.name}, second order": np.sqrt(3) / 2 * (up + down - 2 * before)}
        found |= {name: Contribution(term.source, part) for name, part in parts.items() if np.nan_to_num(part).any()}
    return found


def joint_covariance(statements: Sequence[Statement]) -> Array:
    """(12 M, 12 M) covariance of the results of M methods: of their differences, what they share cancels.

    Nuisances of one name are one quantity (one reference, one clamp, one mounting: names carry the position).
    """
    none = np.zeros(12)
    names = list(dict.fromkeys(name for s in statements for name in s.contributions))
    changes = [
        np.concatenate([s.contributions[name].change if name in s.contributions else none for s in statements])
        for name in names
    ]
    type_a = np.concatenate([s.u_type_a for s in statements])
    stacked = np.array(changes)
    return np.asarray(np.einsum("si,sj->ij", stacked, stacked) + np.diag(type_a**2))


def _offset(nuisances: Nuisances, z: Array) -> Array:
    return np.asarray(np.einsum("j,jpk->pk", z, nuisances.offset))
