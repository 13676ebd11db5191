"""What S and Q owe to the errors of one reference, so that results of one reference can be compared and corrected.

The unknowns g of a reference (errors of its sensitivity, drift, corner) entered the estimation with priors N(m, P0)
once. If the means of these priors change by d, the estimate of x = (S, Q) changes by D d, D = C P0^-1, where C is the
covariance of x and g in the Gaussian posterior. The error of x contains -D times the error of m. So two results of one
reference, x1 and x2, have the covariance D1 P0 D2', and that of their difference is P1 + P2 - D1 P0 D2' - D2 P0 D1'.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.estimate.estimate import Now
from calib.estimate.quantities import REFERENCE, REFERENCE_CORNER
from calib.estimate.unknowns import EXACT
from calib.model import Array


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceShare:
    """The n unknowns of one reference that has the name `reference`, and what S and Q owe to them.

    `sensitivity` is that of its certificate, (1,) or (3,) by channel. `kinds`: of calib.estimate.quantities.KINDS, by
    unknown. `stated`, `u_stated` (n,): their priors. `value` (n,): their estimates. `own_derivative` (n, n) and
    `derivative` (12, n): of the estimates and of S row by row and Q by the priors' means. An unknown that walked
    stands with its first value, that at which the state began to use the reference.
    """

    reference: str
    sensitivity: Array
    unknowns: tuple[str, ...]
    kinds: tuple[str, ...]
    stated: Array
    u_stated: Array
    value: Array
    own_derivative: Array
    derivative: Array

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> ReferenceShare:
        """The share whose `asdict` this is, with lists in the place of tuples."""
        return cls(**{**state, "unknowns": tuple(state["unknowns"]), "kinds": tuple(state["kinds"])})

    def as_object(self, serial_number: str, certificate_sha256: str) -> dict[str, Any]:
        """The share as results state it (docs/shared-errors.md): `derivative` has a row for each unknown."""
        return {
            "reference": self.reference, "serial_number": serial_number, "certificate_sha256": certificate_sha256,
            "sensitivity": self.sensitivity.tolist(), "unknowns": list(self.unknowns), "kinds": list(self.kinds),
            "stated": self.stated.tolist(), "u_stated": self.u_stated.tolist(), "value": self.value.tolist(),
            "own_derivative": self.own_derivative.T.tolist(), "derivative": self.derivative.T.tolist(),
        }  # fmt: skip

    def restated(
        self, sensitivity: Array, u_relative: Array, corner_hz: tuple[float, float] | None = None
    ) -> tuple[Array, Array]:
        """The priors (n,), (n,) by another certificate: `sensitivity` and its relative standard uncertainty, each (1,)
        or one for each channel; `corner_hz` with its u, if stated. That of a drift stays as it is."""
        stated, u_stated = self.stated.copy(), self.u_stated.copy()
        own = [k for k, kind in enumerate(self.kinds) if kind == REFERENCE.name]
        ratio = np.broadcast_to(sensitivity / self.sensitivity, len(own))
        stated[own], u_stated[own] = ratio - 1.0, ratio * np.broadcast_to(u_relative, len(own))
        if corner_hz is not None:
            corner = [k for k, kind in enumerate(self.kinds) if kind == REFERENCE_CORNER.name]
            stated[corner], u_stated[corner] = corner_hz
        return stated, u_stated

    def corrected(self, parameters: Array, covariance: Array, stated: Array, u_stated: Array) -> tuple[Array, Array]:
        """S and Q (12,) and their covariance (12, 12) with other priors of the unknowns: `stated`, `u_stated` (n,).

        That is the exchange of a prior in information form, exact for a linear problem with the same data and weights.
        """
        p0, p1 = self.u_stated**2, u_stated**2
        gained = 1.0 - p1 / p0
        C, V = self.derivative * p0, self.own_derivative * p0
        told = stated - (1.0 - gained) * self.stated - gained * self.value
        moved = C @ np.linalg.solve(np.diag(p1) + gained[:, None] * V, told)
        less = C @ (gained[:, None] * np.linalg.solve(np.diag(p1) + V * gained, C.T))
        return parameters + moved, covariance - 0.5 * (less + less.T)


def shared_covariance(one: Sequence[ReferenceShare], other: Sequence[ReferenceShare]) -> Array:
    """(12, 12) covariance of the parameters of two results (rows: `one`), from the references that both rest on.

    A reference that drifts is a random walk: the covariance of two of its values is the variance of the earlier one.
    """
    found = np.zeros((12, 12))
    theirs = {share.reference: share for share in other}
    for mine in one:
        its = theirs.get(mine.reference)
        for j, name in enumerate(mine.unknowns):
            if its is not None and name in its.unknowns:
                k = its.unknowns.index(name)
                u = min(mine.u_stated[j], its.u_stated[k])
                found += u**2 * np.outer(mine.derivative[:, j], its.derivative[:, k])
    return found


def share_in(now: Now, factor: Array, reference: str, sensitivity: float) -> ReferenceShare:
    """The share of a reference in what is known now. `factor` (12, N or more): of the covariance of S and Q."""
    n = len(now)
    own = [
        k
        for k, unknown in enumerate(now.unknowns.all)
        if unknown.quantity.kind.of_certificate and unknown.quantity.owner == reference
        and unknown.quantity.centre == unknown.quantity.kind.since_certificate and unknown.u > EXACT
    ]  # fmt: skip
    unknowns = [now.unknowns.all[k] for k in own]
    variance = np.array([unknown.u for unknown in unknowns]) ** 2
    rows = now.factor[own]
    return ReferenceShare(
        reference, np.array([sensitivity]), tuple(u.quantity.name for u in unknowns),
        tuple(u.quantity.kind.name for u in unknowns), np.array([u.mean for u in unknowns]), np.sqrt(variance),
        now.mean[own], rows @ rows.T / variance, (factor[:, :n] @ rows.T) / variance,
    )  # fmt: skip
