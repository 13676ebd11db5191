"""The nuisances: unknowns other than S and Q (angles, offsets, the reference, gravity, lag), each with a stated prior.

calib.estimate.terms has the effect of each nuisance. For P poses and M reference channels the input acceleration in the
sensor's frame is

    a(t) = D u(t - lag) + D' u'(t) / omega + G
    D = R(turn) (D0 + t L) / (1 + r)        D' = R(turn) q L        G = R(turn') G0 (1 + dg / |G0|)

D0, G0 are the stated direction and gravity (Eqs. 9-11 on the clamp), R rotations, r the relative error of the
reference, dg the error of gravity. t and q are relative motion along L, transverse to a uniaxial reference, which does
not measure it: t in phase with the motion, q 90 deg ahead of it. A table that rocks causes both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calib.estimate.deviations import ByAxis, LeftOpen
from calib.estimate.quantities import (
    LAG,
    PRIORS,
    REFERENCE_CORNER,
    RESPONSE,
    SENSOR_CORNER,
    Kind,
    Stated,
    Statement,
)
from calib.estimate.terms import terms
from calib.model import Array, Pose, own_channels, scale_of
from calib.signal.known_response import UNKNOWN, KnownResponse
from calib.signal.response import ALL_POWERS, FLAT, POWERS, Response, by_term

# Standard uncertainty of a term of the response, relative to that of a low-pass filter at the upper end of the motion.
# It is honest for filters, means and resonances from 1.5 times that frequency on (shown by benchmarks.response).
RESPONSE_U = 10.0
# Of ln |h| at one frequency: what resonances at 30 times this frequency add, which cause hardly a lag; the most that
# a lag says, because clocks that differ cause larger lags than filters do.
ATTENUATED_U, MOST_ATTENUATED = 1e-3, 2e-2


@dataclass(frozen=True, init=False)
class Priors(Stated):
    """The priors: a standard uncertainty (GUM type B) for each nuisance, and for some of them a mean.

    Each number is an attribute; calib.estimate.quantities has the names, units and defaults. A standard uncertainty of
    0 fixes the nuisance at its mean. With `Priors.none()` all are fixed, and the adjustment is plain Method 3 (section
    2.3). `parameters` (12,) and `covariance` (12, 12) are the prior of S and Q in the order of calib.model.PARAMETERS;
    the diagonal is inf for each parameter without a prior.
    """

    table: ClassVar[Mapping[str, Statement]] = PRIORS
    parameters: Array | None = field(default=None, compare=False)
    covariance: Array | None = field(default=None, compare=False)
    known: KnownResponse = field(default=UNKNOWN, compare=False)

    def __init__(
        self,
        values: Mapping[str, float] | None = None,
        parameters: Array | None = None,
        covariance: Array | None = None,
        known: KnownResponse = UNKNOWN,
        **stated: float,
    ) -> None:
        """`stated` overrides `values`, and `values` override the defaults. Raises TypeError for an unknown name."""
        super().__init__(values, **stated)
        object.__setattr__(self, "parameters", parameters)
        object.__setattr__(self, "covariance", covariance)
        object.__setattr__(self, "known", known)

    def with_values(self, told: Mapping[str, float]) -> Priors:
        """The same with these values in the place of others."""
        return Priors({**self.values, **told}, self.parameters, self.covariance, self.known)

    def beside_known(self, known: KnownResponse) -> Priors:
        """These for instruments with filters that are known, and are divided out of the data: all but their delay,
        which is part of the lag."""
        late = {"lag_at_s": self.lag_at_s + known.group_delay_s} if known.is_stated else {}
        return Priors({**self.values, **late}, self.parameters, self.covariance, known)

    def _known_told(self, frequency_hz: float, to_hz: float = 0.0) -> dict[str, float]:
        """What known filters make of S, if it holds at this frequency, from a motion up to `to_hz`.

        `known_size`: ln |h| of the sensor's. `reference_share`: of what is left of ln |h|, the other part is the
        sensor's; `known_u`: relative standard uncertainty of S by this division, and by what no terms explain.
        """
        if not self.known.is_stated:
            return {}
        share, u = self.known.of_reference(frequency_hz)
        size = float(np.log(self.known.sensor_size(frequency_hz)))
        u_beside = self.known.u_beside_terms(to_hz) if to_hz else 0.0
        return {"known_size": size, "known_u": float(np.hypot(u, u_beside)), "reference_share": share}

    def with_response(
        self, band_hz: tuple[float, float], to_hz: float | None = None, from_hz: float | None = None
    ) -> Priors:
        """These and the priors of the response over frequency up to `to_hz`, for a motion in `band_hz`.

        Where a corner is unknown, the motion begins at `from_hz`. S holds at the frequency that is stated, or in the
        middle of the band.
        """
        stated_hz = self.reference_frequency_hz or float(np.sqrt(band_hz[0] * band_hz[1]))
        told = {
            "response": min(RESPONSE_U, self.known.u_response(to_hz or band_hz[1])), "response_at": 0.0,
            "response_terms": float(len(ALL_POWERS if self.corner_unknown else POWERS)),
            "response_from_hz": (from_hz or band_hz[0]) if self.corner_unknown else 0.0,
            "response_hz": to_hz or band_hz[1], "reference_frequency_hz": stated_hz,
        }  # fmt: skip
        return self.with_values({**told, **self._known_told(stated_hz, to_hz or band_hz[1])})

    @property
    def output_per_mps2(self) -> float | None:
        """The sensor's scale in output unit per m/s2 by the main sensitivities that were known beforehand; None where
        one of them was not, or only in combinations."""
        if self.parameters is None or self.covariance is None:
            return None
        scale, u = scale_of(self.parameters), np.sqrt(self.covariance.diagonal()[[0, 4, 8]])
        return scale if np.isfinite(scale) and (u < scale).all() else None

    @property
    def beside_unknown_corner(self) -> Priors:
        """These for instruments of which one is AC-coupled, and nobody stated its corner."""
        return self.with_values({"corner_unknown": 1.0})

    @property
    def response_powers(self) -> int:
        """How many powers of the frequency the terms of the response have: 5, or 9 with those below the motion."""
        return len(ALL_POWERS if self.response_from_hz else POWERS)

    def at_one_frequency(self, motion_hz: float, lag_s: float) -> Priors:
        """These and the prior of the response at `motion_hz`, the only frequency of the motion, where the sensor's
        indications come after the reference's by `lag_s`. S holds at the frequency that is stated, or at this one.

        One frequency cannot tell how much an instrument's filter attenuates it. A causal low-pass filter that delays by
        L attenuates by nothing if it is a pure delay, and by (omega L)^2 / 2 if it is of first order; others lie
        between these two. The prior has its mean in the middle of the two and both at one standard uncertainty.
        """
        late_s = lag_s - self.lag_at_s
        most = min(0.5 * (2.0 * np.pi * motion_hz * late_s) ** 2, MOST_ATTENUATED)
        attenuated = 0.5 * most * float(np.sign(late_s))  # a reference that comes late is the one that attenuates
        u = float(np.hypot(0.5 * most, ATTENUATED_U))
        if (u_known := float(np.hypot(self.known.u_size(motion_hz), ATTENUATED_U))) < u:
            u, attenuated = u_known, 0.0
        at_hz = self.reference_frequency_hz or motion_hz
        told = {
            "response": u, "response_at": attenuated, "response_terms": 1.0, "response_hz": motion_hz,
            "reference_frequency_hz": at_hz,
        }  # fmt: skip
        return self.with_values({**told, **self._known_told(at_hz)})


@dataclass(frozen=True, slots=True)
class Applied:
    """The values that the front end has already removed from the data. Reported values of nuisances contain them."""

    lag_s: float = 0.0
    reference_corner_hz: float = 0.0
    sensor_corner_hz: float = 0.0
    response: Response = FLAT

    @classmethod
    def of(cls, priors: Priors, lag_s: float, response: Response = FLAT) -> Applied:
        """This lag and response, and the corners at the means of their priors, because no search finds the corners."""
        return cls(lag_s, priors.reference_corner_at_hz, priors.sensor_corner_at_hz, response)

    @property
    def by_kind(self) -> dict[Kind, tuple[float, ...]]:
        """The same values by the kind of the unknown."""
        return {
            LAG: (self.lag_s,),
            REFERENCE_CORNER: (self.reference_corner_hz,),
            SENSOR_CORNER: (self.sensor_corner_hz,),
            RESPONSE: self.response.terms,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """The inputs at given values of the J nuisances, and their derivatives with respect to each nuisance.

    `direction` (P, 3, M) applies to the motion, `mean_direction` (P, 3, M) to the means of the reference. They differ
    for silent channels, which have no motion of their own, but whose means act on the sensor. `rate_direction`
    (P, 3, M) in s applies to the motion's derivative: it is the part of the silent channels' motion that is 90 deg
    ahead. `quadrature` (P, 3) is relative motion 90 deg ahead that the reference does not measure; `gravity` (P, 3) in
    m/s2; `lag_s` (3,); `reference_corner` and `sensor_corner` in rad/s; `response` (5,) or (9,) in s^k. The
    derivatives `d_...` have the same shapes with J in front.
    """

    direction: Array
    mean_direction: Array
    rate_direction: Array
    quadrature: Array
    gravity: Array
    lag_s: Array
    reference_corner: float
    sensor_corner: float
    response: Array
    d_direction: Array
    d_mean_direction: Array
    d_rate_direction: Array
    d_quadrature: Array
    d_gravity: Array


class Nuisances:
    """The J nuisances of P poses whose uncertainty is not 0, with their effects stacked as arrays (J, ...)."""

    def __init__(
        self, poses: Sequence[Pose], channels: int, priors: Priors, applied: Applied, reference: str = ""
    ) -> None:
        """`reference` is the identity of the reference; see calib.estimate.terms."""
        self.terms = [t for t in terms(poses, channels, priors, applied.by_kind, reference) if t.uncertainty > 0.0]
        n = len(poses)
        self._stated = np.zeros((n, 3, channels))
        self._along, self._along_rate = np.tile(np.eye(channels), (n, 1, 1)), np.zeros((n, channels, channels))
        for p, pose in enumerate(poses):
            m = pose.direction.shape[1]
            self._stated[p, :, :m] = pose.direction
            if pose.along is not None:
                self._along[p, :m, :m] = pose.along
            if pose.along_rate_s is not None:
                self._along_rate[p, :m, :m] = pose.along_rate_s
        self.direction, self.mean_direction = self._stated @ self._along, self._stated
        stated = np.array([pose.gravity_mps2 for pose in poses])
        self.known: NDArray[np.bool_] = np.isfinite(stated).all(axis=1)
        self.gravity = np.where(self.known[:, None], stated, 0.0)  # 0 in a pose whose gravity is not known
        self._real = own_channels(channels)
        self._magnitude = np.maximum(np.linalg.norm(self.gravity, axis=1), np.finfo(float).tiny)
        by_direction, by_gravity = (self._stacked(f"turn_{of}", (n, 3)) for of in ("direction", "gravity"))
        self._turns = np.stack([by_direction, by_gravity], axis=1)
        self._cross_direction, self._cross_gravity = _cross(by_direction), _cross(by_gravity)
        self._transverse = self._stacked("transverse", (n, 3))
        self._quadrature = self._stacked("quadrature", (n, 3))
        self._reference = self._stacked("reference", (channels,))
        self._gravity = self._stacked("gravity", (1,))
        self.offset = self._stacked("offset", (n, 3))
        self.lag = self._stacked("lag", (3,))
        self.reference_corner = self._stacked("reference_corner", (1,))[:, 0]
        self.sensor_corner = self._stacked("sensor_corner", (1,))[:, 0]
        self.response = self._stacked("response", (priors.response_powers,))
        # Of ln |h| at the reference frequency by the terms, when the response is 1 at 0 Hz.
        self.reference_frequency_hz = priors.reference_frequency_hz
        at = np.array([2.0 * np.pi * priors.reference_frequency_hz])
        self._at_reference = (1.0 - priors.reference_share) * by_term(at, priors.response_powers)[0].real
        self._applied_response = self._applied() @ self.response
        self._known_size = priors.known_size
        self._corner_hz = (self.reference_corner - self.sensor_corner) / (2.0 * np.pi)

    def __len__(self) -> int:
        return len(self.terms)

    def with_applied(self, applied: Applied) -> Nuisances:
        """The same nuisances with other values removed from the data: much sooner made than anew."""
        other = copy(self)
        other.terms = [t.with_applied(applied.by_kind) for t in self.terms]
        other._applied_response = other._applied() @ other.response
        return other

    def _applied(self) -> Array:
        return np.array([t.applied for t in self.terms])

    @property
    def uncertainty(self) -> Array:
        """(J,) prior standard uncertainties."""
        return np.array([t.uncertainty for t in self.terms])

    def _stacked(self, name: str, shape: tuple[int, ...]) -> Array:
        maps = [getattr(t, name) for t in self.terms]
        return np.array([np.zeros(shape) if m is None else m for m in maps]).reshape(len(self.terms), *shape)

    def steady(self, z: Array) -> tuple[float, Array]:
        """The sensitivity at 0 Hz over that at the reference frequency, and the derivatives (J,) of its logarithm."""
        away = self._at_reference @ (self._applied_response + z @ self.response) + self._known_size
        return float(np.exp(-away)), -(self.response @ self._at_reference)

    def by_axis(self, z: Array, left_open: LeftOpen) -> ByAxis:
        """The effect of axes that do not respond quite alike, at the values `z` (J,) of the nuisances."""
        terms, powers = self._applied_response + z @ self.response, ALL_POWERS[: len(self._at_reference)]
        return left_open.by_axis(terms, self._at_reference, powers)

    def at(self, z: Array) -> Inputs:
        """The inputs when the nuisances have the values `z` (J,)."""
        turn, gravity_turn = rotations(np.einsum("j,jgpk->gpk", z, self._turns))
        scale = 1.0 + np.einsum("j,jm->m", z, self._reference)
        sideways = self._stated.copy()
        if sideways.shape[2]:
            sideways[:, :, 0] += np.einsum("j,jpk->pk", z, self._transverse)
        real = self._real
        felt = turn @ sideways[:, :, :real]
        # A corner of c Hz removed c times the integral; the integrals are channels of their own (calib.signal.corner).
        direction = np.concatenate([felt, float(z @ self._corner_hz) * felt], axis=2)[:, :, : sideways.shape[2]] / scale
        d_direction = self._cross_direction @ direction
        d_direction -= direction * (self._reference / scale)[:, None, None, :]
        if real:
            d_direction[..., 0] += np.einsum("pik,jpk->jpi", turn, self._transverse) / scale[0]
            d_direction[..., real:] += (
                self._corner_hz[:, None, None, None] * (felt / scale[:real])[..., : sideways.shape[2] - real]
            )
        # The product of turn and quadrature is neglected: at most 1 % of 0.2 deg.
        d_quadrature = np.einsum("pik,jpk->jpi", turn, self._quadrature)
        stretch = 1.0 + np.einsum("j,jo->o", z, self._gravity) / self._magnitude
        unstretched = np.einsum("pik,pk->pi", gravity_turn, self.gravity)
        gravity = unstretched * stretch[:, None]
        d_gravity = (self._cross_gravity @ gravity[..., None])[..., 0] + self._gravity[:, :, None] * (
            unstretched / self._magnitude[:, None]
        )
        return Inputs(
            direction @ self._along,
            direction,
            direction @ self._along_rate,
            np.einsum("jpk,j->pk", d_quadrature, z),
            gravity,
            z @ self.lag,
            float(z @ self.reference_corner),
            float(z @ self.sensor_corner),
            z @ self.response,
            d_direction @ self._along,
            d_direction,
            d_direction @ self._along_rate,
            d_quadrature,
            d_gravity,
        )


def rotations(vectors: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad, by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    cross = _cross(vectors)
    linear, square = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.asarray(np.eye(3) + linear * cross + square * (cross @ cross))


def _cross(vectors: Array) -> Array:
    """Matrices (..., 3, 3) that give the vector product of `vectors` (..., 3) with another vector."""
    cross = np.zeros((*vectors.shape, 3))
    cross[..., [2, 0, 1], [1, 2, 0]] = vectors
    cross[..., [1, 2, 0], [2, 0, 1]] = -vectors
    return cross
