"""GUM propagation for methods that do not estimate their nuisances: the effect of each nuisance on the result.

A method is described by its response: the result that it gives for a sensor with known S and Q if a nuisance changes
the inputs and the method does not know of it. The nuisances and their priors are those of the adjustment
(calib.estimate).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.distributions import coverage_factor
from calib.estimate.terms import Inputs, Nuisances
from calib.model import Array

Response = Callable[[Inputs], Array]
"""inputs -> (12,) as calib.model.PARAMETERS; NaN for parameters the method does not give."""


@dataclass(frozen=True, slots=True, eq=False)
class Contribution:
    """Change (12,) of the parameters, in their units, if a nuisance changes by its standard uncertainty."""

    source: str
    change: Array


@dataclass(frozen=True, slots=True, eq=False)
class MethodUncertainty:
    """The uncertainty of the result of one method: type B contributions by nuisance, and the type A part.

    `u_type_a` (12,) and its degrees of freedom `freedom_type_a` (12,); NaN for parameters the method does not give.
    """

    contributions: Mapping[str, Contribution]
    u_type_a: Array
    freedom_type_a: Array

    @property
    def covariance(self) -> Array:
        """(12, 12) covariance of all sources together."""
        return joint_covariance([self])

    @property
    def by_source(self) -> dict[str, Array]:
        """{source: (12,) standard uncertainty}, with type A; the squares add up to that of the combined uncertainty."""
        squares = {"type A": self.u_type_a**2}
        for contribution in self.contributions.values():
            squares[contribution.source] = squares.get(contribution.source, 0.0) + contribution.change**2
        return {source: np.sqrt(square) for source, square in squares.items()}

    @property
    def coverage_factor(self) -> float:
        """k for 95.45 %, for the parameter with the fewest effective degrees of freedom (Welch-Satterthwaite, GUM
        G.2b)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            effective = np.diag(self.covariance) ** 2 / (self.u_type_a**4 / self.freedom_type_a)
        return coverage_factor(float(np.nanmin(effective, initial=np.inf)))


def propagate(response: Response, nuisances: Nuisances) -> dict[str, Contribution]:
    """Contributions of all nuisances, each moved by plus and minus its standard uncertainty.

    The second order is a contribution of its own: for a normal nuisance z of variance u2 the term f'' z2 / 2 has mean
    f'' u2 / 2, which the methods do not correct, and SD f'' u2 / sqrt(2) (GUM 5.1.2, note): together sqrt(3)/2 f'' u2.
    The first order is 0 for main sensitivities if an axis is exactly along the motion, as in Method 1.
    """
    none = np.zeros(len(nuisances))
    before = response(nuisances.at(none))
    found: dict[str, Contribution] = {}
    for term, one in zip(nuisances.terms, np.diag(nuisances.uncertainty), strict=True):
        up, down = (response(nuisances.at(z)) for z in (one, -one))
        parts = {term.name: (up - down) / 2, f"{term.name}, second order": np.sqrt(3) / 2 * (up + down - 2 * before)}
        found |= {name: Contribution(term.source, part) for name, part in parts.items() if np.nan_to_num(part).any()}
    return found


def joint_covariance(statements: Sequence[MethodUncertainty]) -> Array:
    """(12 M, 12 M) joint covariance of the results of M methods; common errors cancel in their differences.

    Nuisances with the same name are one quantity (one reference, one clamp, one mounting); the name has the position.
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
