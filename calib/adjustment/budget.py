"""The uncertainty budget of S and Q: a standard uncertainty for each source, and the effective degrees of freedom.

The covariance of the estimate is H^-1 (J' C J + P) H^-1, where H is the information, J the Jacobian, C the scatter that
the windows show, and P the precision of the priors. Each term of C or P is a source. The covariance is right for
coloured residuals too, although they are weighted as if they were white.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.adjustment.across import Across
from calib.adjustment.scatter import between_windows
from calib.adjustment.solution import Solution, slope_residuals
from calib.model import Array
from calib.windows.banded import Banded
from calib.windows.deviations import BetweenBands


@dataclass(frozen=True, slots=True, eq=False)
class Budget:
    """The uncertainty budget.

    `covariance` (N, N) of [S, Q, nuisances]; `contributions` {source: (12,)} are standard uncertainties whose squares
    add up to its diagonal. `degrees_of_freedom` (12,) are the effective ones (Welch-Satterthwaite, GUM G.2b).
    `offset_scatter_mps2` and `slope_scatter` (relative) are the scatter between windows as estimated; both are 0 if
    noise and priors explain all of it.
    """

    covariance: Array
    contributions: Mapping[str, Array]
    degrees_of_freedom: Array
    offset_scatter_mps2: float
    slope_scatter: float
    between_bands: BetweenBands
    consistency: tuple[float, float]  # chi-squared of the windows against noise and stated scatter, and its expectation


def budget(solution: Solution, stated_offset_scatter_mps2: float, known_u: float, across: Across) -> Budget:
    """The budget of a solution. `stated_offset_scatter_mps2` is the prior scatter of the offset between windows,
    `known_u` relative of S: whose filter differs from what is stated. `across`: what was taken out of an output."""
    seen = between_windows(solution)
    noise = _type_a(solution)
    sources = {"type A": (noise, solution.equations.data.type_a.degrees_of_freedom)}
    sources |= solution.equations.scatter.terms(slope_residuals(solution)[1])
    if stated_offset_scatter_mps2 > 0.0:
        larger = max(stated_offset_scatter_mps2, seen.offset.scatter)
        freedom = seen.offset.degrees_of_freedom if larger > stated_offset_scatter_mps2 else np.inf
        sources["offset between windows"] = (larger**2 * seen.offset.term, freedom)
    if seen.slope.scatter > 0.0:
        sources["slopes between windows"] = (seen.slope.scatter**2 * seen.slope.term, seen.slope.degrees_of_freedom)
    if known_u > 0.0:
        sources["known filters"] = (_alike(solution, known_u), np.inf)
    if across.output is not None:
        along = slice(4 * across.output, 4 * across.output + 1)
        sources["transverse motion, by other outputs"] = (_alike(solution, across.u, along), np.inf)
    banded = solution.equations.data.bands
    if banded is not None:
        sources |= {name: (middle, np.inf) for name, middle in _of_bands(solution, banded).items()}
    half = solution.half
    sources["prior of S and Q"] = (half[:12].T @ solution.prior_precision[:12, :12] @ half[:12], np.inf)
    sources |= {source: (middle, np.inf) for source, middle in _of_nuisances(solution).items()}
    total = np.sum([middle for middle, _ in sources.values()], axis=0)
    variances = {name: _variances(half[:12], middle) for name, (middle, _) in sources.items()}
    spent = np.sum([variances[name] ** 2 / freedom for name, (_, freedom) in sources.items()], axis=0)
    with np.errstate(divide="ignore"):
        effective = _variances(half[:12], total) ** 2 / spent
    return Budget(
        covariance=half @ total @ half.T,
        contributions={name: np.sqrt(v) for name, v in variances.items()},
        degrees_of_freedom=effective,
        offset_scatter_mps2=seen.offset.scatter,
        slope_scatter=seen.slope.scatter,
        between_bands=BetweenBands() if banded is None else banded.between,
        consistency=seen.consistency,
    )


def _variances(half: Array, middle: Array) -> Array:
    """Diagonal of half middle half', not below 0."""
    return np.asarray(np.maximum(np.einsum("in,in->i", half @ middle, half), 0.0))


def _type_a(solution: Solution) -> Array:
    """(N, N) part of the scatter within windows: (J half)' C (J half)."""
    equations = solution.equations
    _, mean_rows = equations.split(solution.jacobian)
    type_a = equations.data.type_a
    slope_rows = equations.scatter.whiten(slope_residuals(solution)[1])
    mean_rows = mean_rows * np.sqrt(equations.white_share)[..., None]
    band_rows = equations.band_rows(solution.jacobian)
    return _quadratic(slope_rows, type_a.slopes) + _quadratic(mean_rows, type_a.means) + band_rows.T @ band_rows


def _of_nuisances(solution: Solution) -> dict[str, Array]:
    """The sources that the priors of the nuisances state."""
    terms, half, found = solution.equations.nuisances.terms, solution.half, {}
    for source in dict.fromkeys(t.source for t in terms):
        own = np.array([half[12 + j] / t.uncertainty for j, t in enumerate(terms) if t.source == source])
        found[source] = own.T @ own
    return found


def _of_bands(solution: Solution, banded: Banded) -> dict[str, Array]:
    """The sources that the bands of frequency show, and those that they leave open (calib.windows.deviations)."""
    nuisances, sources = solution.equations.nuisances, dict[str, Array]()
    by_axis = nuisances.by_axis(solution.x[12:], banded.left_open)
    if (u_between := banded.between.beyond(by_axis.explains)) > 0.0:
        sources["response between bands"] = _alike(solution, u_between)
    if (u_lost := banded.left_open.u_lost(nuisances.reference_frequency_hz)) > 0.0:
        sources["whose noise it is"] = _alike(solution, u_lost)
    if by_axis.u > 0.0:
        rows = [slice(3 * row, 3 * row + 3) for row in range(3)]
        sources["response by axis"] = np.sum([_alike(solution, by_axis.u, row) for row in rows], axis=0)
    return sources


def _alike(solution: Solution, relative: float, elements: slice = slice(9)) -> Array:
    """(N, N) of a relative standard uncertainty that these elements of S share."""
    S = np.zeros(len(solution.x))
    S[elements] = solution.x[elements]
    rows = slope_residuals(solution)[1]
    rows = rows.reshape(-1, rows.shape[-1])
    loading = rows.T @ (rows @ np.linalg.solve(solution.half, S))
    return np.asarray(relative**2 * np.outer(loading, loading))


def _quadratic(rows: Array, covariance: Array) -> Array:
    """Sum over blocks of rows' C rows: rows (B, D, N), C (D, D)."""
    return np.asarray(np.tensordot(rows, covariance @ rows, axes=([0, 1], [0, 1])))
