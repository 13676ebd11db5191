"""What an adjustment says of the response over frequency: for which frequencies S holds, and S at others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.signal.known_response import UNKNOWN, KnownResponse
from calib.signal.response import ALL_POWERS, NEAR, Complex, Response, by_term

if TYPE_CHECKING:
    from calib.estimate.nuisances import Priors

PER_OCTAVE = 3  # bands in which S is reported
GRID = 200  # frequencies at which the valid band is searched
LEFT_U = 1.0  # standard uncertainties of ln h that may be left in the windows


@dataclass(frozen=True, slots=True)
class KnownResponses:
    """The filters that are known, and the sensor's `shares` (9,) of the response that is left, by term."""

    response: KnownResponse = UNKNOWN
    shares: tuple[float, ...] = (1.0,) * len(ALL_POWERS)

    @classmethod
    def of(cls, priors: Priors) -> KnownResponses:
        """What the priors state."""
        return cls(priors.known, tuple((1.0 - priors.reference_shares).tolist()))

    def size(self, frequency_hz: Array, reference_hz: float) -> Complex | float:
        """h of the sensor's known filters at frequencies, over its size at the reference frequency."""
        own = self.response
        return own.of_sensor(frequency_hz) / own.sensor_size(reference_hz) if own.sensor else 1.0


NOTHING = KnownResponses()


@dataclass(frozen=True, slots=True, eq=False)
class BandSensitivity:
    """The complex sensitivity (3, 3) in a band of frequency, the lag taken out, and its standard uncertainty (3, 3)."""

    low_hz: float
    high_hz: float
    sensitivity: Complex
    standard_uncertainty: Array


@dataclass(frozen=True, slots=True, eq=False)
class ResponseTold:
    """The response of the sensor over that of the reference, as estimated.

    S of the calibration is that at `reference_frequency_hz`. In `valid_band_hz` S alone is right within a third of U.
    `at_0hz` and `u_at_0hz` (3, 3) are the sensitivity at 0 Hz and its standard uncertainty. `bands` cover the motion.
    `covariance` (K, K) is that of the K terms.
    """

    terms: Response
    reference_frequency_hz: float
    valid_band_hz: tuple[float, float]
    at_0hz: Array
    u_at_0hz: Array
    bands: tuple[BandSensitivity, ...]
    covariance: Array

    def is_taken_out(self, taken: Response, left_u: float = LEFT_U) -> bool:
        """Whether `taken` differs from it by less than NEAR or `left_u` of its standard uncertainty: what is left is
        small enough to be estimated by linear equations."""
        low_hz, high_hz = max(self.terms.from_hz, taken.from_hz), max(self.terms.to_hz, taken.to_hz)
        frequency_hz = np.linspace(low_hz, high_hz, 50)
        effects = by_term(2.0 * np.pi * frequency_hz, len(self.covariance))
        u = np.sqrt(np.maximum(np.sum((effects @ self.covariance) * effects.conj(), axis=1).real, 0.0))
        left = np.abs(self.terms.at(frequency_hz) - taken.at(frequency_hz))
        return bool(np.all(left < np.maximum(NEAR, left_u * u)))


def response_of(
    estimate: Array,
    covariance: Array,
    effects: Array,
    reference_hz: float,
    band_hz: tuple[float, float],
    coverage_factor: float,
    per_octave: float = PER_OCTAVE,
    from_hz: float = 0.0,
    known: KnownResponses = NOTHING,
) -> ResponseTold:
    """The response from S row by row and J unknowns of the response: `estimate` (9 + J,), `covariance` (9 + J, 9 + J).

    `effects` (J, 5) or (J, 9): what a unit of each of the J unknowns adds to the terms in s^k. The motion was in
    `band_hz`; `from_hz` is that of the terms below it, where they are unknowns. The terms are those of what is left
    beside the `known` filters; the sensitivities contain the sensor's.
    """
    count = max(1, round(per_octave * np.log2(band_hz[1] / band_hz[0])))
    edges = _spaced(*band_hz, count + 1)
    middles_hz = np.append(0.0, np.sqrt(edges[:-1] * edges[1:]))
    at, u_at = _sensitivities(estimate, covariance, effects, middles_hz, reference_hz, known)
    ends = zip(edges[:-1].tolist(), edges[1:].tolist(), at[1:], u_at[1:], strict=True)
    terms, grid = estimate[9:] @ effects, _spaced(*band_hz, GRID)
    left = _log_h(grid, reference_hz, known.shares[: len(terms)]) @ terms
    away = np.abs(known.size(grid, reference_hz) * np.exp(left))
    limit = coverage_factor * _least_u(estimate[:9], covariance) / 3.0
    return ResponseTold(
        Response(tuple(terms.tolist()), band_hz[1], from_hz),
        reference_hz,
        _around(grid, np.abs(away - 1.0) <= limit, reference_hz),
        at[0].real,
        u_at[0],
        tuple(BandSensitivity(*end) for end in ends),
        effects.T @ covariance[9:, 9:] @ effects,
    )


def response_at_one_frequency(
    estimate: Array,
    covariance: Array,
    effects: Array,
    reference_hz: float,
    band_hz: tuple[float, float],
    coverage_factor: float,
    known: KnownResponses = NOTHING,
) -> ResponseTold:
    """The same where all motion has one frequency, both ends of `band_hz`, and J = 1: the term in s^2 alone.

    The valid band follows from the largest such term, in size, that the data and its prior allow.
    """
    motion_hz = band_hz[1]
    at, u_at = _sensitivities(estimate, covariance, effects, np.array([0.0, motion_hz]), reference_hz, known)
    most = (abs(estimate[9]) + coverage_factor * np.sqrt(covariance[9, 9])) * abs(effects[0, 0])
    most += abs(np.log(known.response.sensor_size(motion_hz))) / (2.0 * np.pi * motion_hz) ** 2
    away = coverage_factor * _least_u(estimate[:9], covariance) / 3.0 / most / (2.0 * np.pi) ** 2  # in Hz^2
    return ResponseTold(
        Response(tuple((estimate[9:] @ effects).tolist()), motion_hz),
        reference_hz,
        (float(np.sqrt(max(reference_hz**2 - away, 0.0))), float(np.sqrt(reference_hz**2 + away))),
        at[0].real,
        u_at[0],
        (BandSensitivity(motion_hz, motion_hz, at[1], u_at[1]),),
        effects.T @ covariance[9:, 9:] @ effects,
    )


@lru_cache(maxsize=8)
def _spaced(low_hz: float, high_hz: float, count: int) -> Array:
    """(count,) frequencies in steps of one ratio, cached and read-only: those of a channel are always the same."""
    found = np.geomspace(low_hz, high_hz, count)
    found.flags.writeable = False
    return found


def _least_u(S: Array, covariance: Array) -> float:
    """The smallest relative standard uncertainty of an element of S (9,): a response moves each by the same share."""
    size = np.abs(S)
    return float((np.sqrt(np.diag(covariance)[:9])[size > 0.0] / size[size > 0.0]).min(initial=np.inf))


def _sensitivities(
    estimate: Array, covariance: Array, effects: Array, frequency_hz: Array, reference_hz: float, known: KnownResponses
) -> tuple[Complex, Array]:
    """Complex sensitivities (F, 3, 3) at F frequencies, the lag taken out, and their standard uncertainties."""
    S, z = estimate[:9], estimate[9:]
    by_unknown = _log_h(frequency_hz, reference_hz, known.shares[: effects.shape[1]]) @ effects.T  # (F, J)
    h = (known.size(frequency_hz, reference_hz) * np.exp(by_unknown @ z))[:, None]
    moves = np.concatenate([h[..., None] * np.eye(9), (S * h)[..., None] * by_unknown[:, None, :]], axis=2)
    variance = np.sum((moves @ covariance) * moves.conj(), axis=2).real
    return np.asarray((S * h).reshape(-1, 3, 3)), np.sqrt(np.maximum(variance, 0.0)).reshape(-1, 3, 3)


def _log_h(frequency_hz: float | Array, reference_hz: float, shares: tuple[float, ...]) -> Complex:
    """Derivatives (..., K) of the sensor's ln h at frequencies (...,) by the terms, where |h| is 1 at the reference
    frequency. `shares` (K,) of them are the sensor's.

    At 0 Hz of an AC-coupled instrument see calib.signal.response.by_term.
    """
    at = by_term(2.0 * np.pi * np.asarray(frequency_hz, dtype=np.float64), len(shares))
    return np.asarray(shares * (at - by_term(np.array(2.0 * np.pi * reference_hz), len(shares)).real))


def _around(grid: Array, good: NDArray[np.bool_], reference_hz: float) -> tuple[float, float]:
    """The stretch of good frequencies around the reference frequency."""
    middle = int(np.argmin(np.abs(np.log(grid / reference_hz))))
    bad = np.flatnonzero(~good)
    low, high = bad[bad < middle], bad[bad > middle]
    first = int(low[-1]) + 1 if low.size else 0
    last = int(high[0]) - 1 if high.size else len(grid) - 1
    return float(min(grid[first], reference_hz)), float(max(grid[last], reference_hz))
