"""What an adjustment says of the response over frequency: for which frequencies S holds, and S at others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.estimate.gauss_newton import Solution
from calib.estimate.quantities import RESPONSE
from calib.model import Array
from calib.signal.response import Complex, Response, by_term

PER_OCTAVE = 3  # bands in which S is reported
LARGE = 0.5  # of the largest element of S: the elements whose relative uncertainty counts
GRID = 200  # frequencies at which the valid band is searched


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
    """

    terms: Response
    reference_frequency_hz: float
    valid_band_hz: tuple[float, float]
    at_0hz: Array
    u_at_0hz: Array
    bands: tuple[BandSensitivity, ...]


def response_told(
    solution: Solution, covariance: Array, reference_hz: float, band_hz: tuple[float, float], coverage_factor: float
) -> ResponseTold:
    """The response of a solution with this covariance (N, N); the motion was in `band_hz`."""
    nuisances = solution.equations.nuisances
    own = np.flatnonzero([t.kind is RESPONSE for t in nuisances.terms])
    effects = nuisances.response[own]  # (K, 5)
    z = solution.x[12 + own] + np.array([nuisances.terms[j].applied for j in own])
    S = solution.x[:9]
    chosen = np.concatenate([np.arange(9), 12 + own])
    joint = covariance[np.ix_(chosen, chosen)]

    def at(frequency_hz: float) -> tuple[Complex, Array]:
        by_nuisance = effects @ _log_h(frequency_hz, reference_hz)
        h = np.exp(z @ by_nuisance)
        moves = np.column_stack([np.eye(9) * h, np.outer(S * h, by_nuisance)])
        variance = np.einsum("pa,ab,pb->p", moves, joint, moves.conj()).real
        return (S * h).reshape(3, 3), np.sqrt(np.maximum(variance, 0.0)).reshape(3, 3)

    at_0hz, u_at_0hz = at(0.0)
    largest = float(np.abs(S).max())
    u = np.sqrt(np.diag(covariance)[:9]) / np.maximum(np.abs(S), LARGE * largest)
    count = max(1, round(PER_OCTAVE * np.log2(band_hz[1] / band_hz[0])))
    edges = np.geomspace(*band_hz, count + 1)
    bands = [
        BandSensitivity(low, high, *at(float(np.sqrt(low * high))))
        for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    ]
    grid = np.geomspace(*band_hz, GRID)
    away = np.array([abs(np.exp(z @ (effects @ _log_h(f, reference_hz)))) - 1.0 for f in grid.tolist()])
    limit = coverage_factor * float(u.min()) / 3.0
    return ResponseTold(
        Response(tuple((z @ effects).tolist()), band_hz[1]),
        reference_hz,
        _around(grid, np.abs(away) <= limit, reference_hz),
        at_0hz.real,
        u_at_0hz,
        tuple(bands),
    )


def _log_h(frequency_hz: float, reference_hz: float) -> Complex:
    """Derivatives (5,) of ln h by the terms, where |h| is 1 at the reference frequency."""
    omega = 2.0 * np.pi * np.array([frequency_hz, reference_hz])
    at, reference = by_term(omega)
    return np.asarray(at - reference.real)


def _around(grid: Array, good: NDArray[np.bool_], reference_hz: float) -> tuple[float, float]:
    """The stretch of good frequencies around the reference frequency."""
    middle = int(np.argmin(np.abs(np.log(grid / reference_hz))))
    bad = np.flatnonzero(~good)
    low, high = bad[bad < middle], bad[bad > middle]
    first = int(low[-1]) + 1 if low.size else 0
    last = int(high[0]) - 1 if high.size else len(grid) - 1
    return float(min(grid[first], reference_hz)), float(max(grid[last], reference_hz))
