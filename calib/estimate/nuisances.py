"""The priors of the nuisances: unknowns other than S and Q (angles, offsets, the reference, gravity, lag).

calib.estimate.terms has the effect of each nuisance on the inputs of a window, calib.estimate.physics what these do.
Stated directions and gravity are those of Eqs. 9-11 on the clamp. Transverse motion that a uniaxial reference does not
measure is in phase with the motion or 90 deg ahead of it; a table that rocks causes both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from calib.estimate.quantities import (
    LAG,
    PRIORS,
    REFERENCE_CORNER,
    RESPONSE,
    SENSOR_CORNER,
    Kind,
    StatedValues,
    Statement,
)
from calib.model import Array, scale_of
from calib.signal.known_response import UNKNOWN, KnownResponse
from calib.signal.response import BELOW, FLAT, NO_MOTION, POWERS, Response, ResponseModel

# Standard uncertainty of a term of the response, relative to that of a low-pass filter at the upper end of the motion.
# It is honest for filters, means and resonances from 1.5 times that frequency on (shown by benchmarks.response).
RESPONSE_U = 10.0
# Of ln |h| at one frequency: what resonances at 30 times this frequency add, which cause hardly a lag; the most that
# a lag says, because clocks that differ cause larger lags than filters do.
ATTENUATED_U, MOST_ATTENUATED = 1e-3, 0.1


@dataclass(frozen=True, init=False)
class Priors(StatedValues):
    """The priors: a standard uncertainty (GUM type B) for each nuisance, and for some of them a mean.

    Each number is an attribute; calib.estimate.quantities has the names, units and defaults. A standard uncertainty of
    0 fixes the nuisance at its mean. With `Priors.none()` all are fixed, and the adjustment is plain Method 3 (section
    2.3). `parameters` (12,) and `covariance` (12, 12) are the prior of S and Q in the order of calib.model.PARAMETERS;
    the diagonal is inf for each parameter without a prior. `response_model`: which terms of the response are unknowns.
    `corner_unknown`: an instrument is AC-coupled, and nobody states its corner.
    """

    table: ClassVar[Mapping[str, Statement]] = PRIORS
    parameters: Array | None = field(default=None, compare=False)
    covariance: Array | None = field(default=None, compare=False)
    known: KnownResponse = field(default=UNKNOWN, compare=False)
    response_model: ResponseModel = NO_MOTION
    corner_unknown: bool = False

    def __init__(
        self,
        values: Mapping[str, float] | None = None,
        parameters: Array | None = None,
        covariance: Array | None = None,
        known: KnownResponse = UNKNOWN,
        response_model: ResponseModel = NO_MOTION,
        corner_unknown: bool = False,
        **stated: float,
    ) -> None:
        """`stated` overrides `values`, and `values` override the defaults. Raises TypeError for an unknown name."""
        super().__init__(values, **stated)
        object.__setattr__(self, "parameters", parameters)
        object.__setattr__(self, "covariance", covariance)
        object.__setattr__(self, "known", known)
        object.__setattr__(self, "response_model", response_model)
        object.__setattr__(self, "corner_unknown", corner_unknown)

    def with_values(self, told: Mapping[str, float]) -> Priors:
        """The same with these values in the place of others."""
        return replace(self, values={**self.values, **told})

    def beside_known(self, known: KnownResponse) -> Priors:
        """These for instruments with filters that are known, and are divided out of the data: all but their delay,
        which is part of the lag."""
        late = {"lag_at_s": self.lag_at_s + known.group_delay_s} if known.is_stated else {}
        return replace(self.with_values(late), known=known)

    @property
    def reference_shares(self) -> Array:
        """(9,) the share of the reference in each term of the response, in the order of ALL_POWERS. The rest is the
        sensor's, and S contains it at the frequency at which S holds."""
        return np.repeat([self.reference_share, self.reference_share_below], [len(POWERS), len(BELOW)])

    def _of_known_filters(self, frequency_hz: float, to_hz: float = 0.0) -> dict[str, float]:
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
        to_hz = to_hz or band_hz[1]
        model = ResponseModel(to_hz, (from_hz or band_hz[0]) if self.corner_unknown else 0.0)
        u = min(RESPONSE_U, self.known.u_response(to_hz))
        told = {"response": u, "response_at": 0.0, "reference_frequency_hz": stated_hz}
        return replace(self.with_values({**told, **self._of_known_filters(stated_hz, to_hz)}), response_model=model)

    @property
    def output_per_mps2(self) -> float | None:
        """The sensor's scale in output unit per m/s2 by the main sensitivities that were known beforehand; None where
        one of them was not, or only in combinations."""
        if self.parameters is None or self.covariance is None:
            return None
        scale, u = scale_of(self.parameters), np.sqrt(self.covariance.diagonal()[[0, 4, 8]])
        return scale if np.isfinite(scale) and (u < scale).all() else None

    def beside_unknown_corner(self, of_reference: float) -> Priors:
        """These for instruments of which one is AC-coupled, and nobody stated its corner. The part `of_reference` of
        what it does is the reference's."""
        return replace(self.with_values({"reference_share_below": of_reference}), corner_unknown=True)

    def at_one_frequency(self, motion_hz: float, lag_s: float) -> Priors:
        """These and the prior of the response at `motion_hz`, the only frequency of the motion, where the sensor's
        indications come after the reference's by `lag_s`. S holds at the frequency that is stated, or at this one.

        One frequency cannot tell how much an instrument's filter attenuates it. A causal low-pass filter that delays by
        L attenuates by nothing if it is a pure delay, and by (omega L)^2 / 2 if it is of first order; others lie
        between these two, most of them near one end. The prior has its mean in the middle of both, and the ends at one
        standard uncertainty.
        """
        late_s = lag_s - self.lag_at_s
        most = min(0.5 * (2.0 * np.pi * motion_hz * late_s) ** 2, MOST_ATTENUATED)
        attenuated = 0.5 * most * float(np.sign(late_s))  # a reference that comes late is the one that attenuates
        u = float(np.hypot(0.5 * most, ATTENUATED_U))
        if (u_known := float(np.hypot(self.known.u_size(motion_hz), ATTENUATED_U))) < u:
            u, attenuated = u_known, 0.0
        at_hz = self.reference_frequency_hz or motion_hz
        told = {"response": u, "response_at": attenuated, "reference_frequency_hz": at_hz}
        model = ResponseModel(motion_hz, one_frequency=True)
        return replace(self.with_values({**told, **self._of_known_filters(at_hz)}), response_model=model)


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
