"""Method 3 by adjustment: S, Q and the nuisances of all windows together, each nuisance with its stated prior.

With every nuisance fixed it is plain Method 3 (section 2.3). The steps, each a file beside this one: condense
the windows (condense), solve their equations (equations, gauss_newton), say where the uncertainty comes from (budget)
and whether the result may be used (verdict).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from calib.adjustment.across import Across, across_of
from calib.adjustment.budget import Budget, budget
from calib.adjustment.equations import Equations
from calib.adjustment.slope_scatter import SlopeScatter, estimated
from calib.adjustment.solution import Solution, share_after, slope_residuals, solve
from calib.adjustment.verdict import misfit, nothing_determined, nuisance_pull, reasons, turned_windows
from calib.distributions import coverage_factor
from calib.estimate.determined import Flags, determined
from calib.estimate.nuisances import Applied, Priors
from calib.estimate.physics import padded
from calib.estimate.quantities import LAG, RESPONSE, Kind
from calib.estimate.reference_share import ReferenceShare
from calib.estimate.response_told import KnownResponses, ResponseTold, response_at_one_frequency, response_of
from calib.model import Array, Calibration, Window
from calib.windows.bands import motion_band_hz
from calib.windows.condense import Condensed, condense, effective
from calib.windows.excited import excited_together
from calib.windows.never_turned import mean_input, never_turned

SCATTER_TURNS = 3  # the first solution is bent by what it takes for exact; the estimate settles in two
SCATTER_SETTLED = 0.05
# Standard uncertainty, over the sensor's scale, of S along a direction that nothing excited, where it becomes a prior.
# An element of which more than UNSEEN_SHARE (calib.adjustment.equations) lies along it may then be off by that scale.
UNKNOWN = 50.0


@dataclass(frozen=True, slots=True)
class Nuisance:
    """A nuisance after the adjustment, in total with what the front end applied."""

    name: str
    kind: Kind
    value: float
    standard_uncertainty: float
    prior_uncertainty: float
    unit: str


@dataclass(frozen=True, eq=False)
class Grounds:
    """What an adjustment was made from, as far as its reasons need it."""

    windows: Sequence[Window]
    solution: Solution
    shares: Budget
    determined: Flags
    data: Condensed
    priors: Priors
    applied: Applied
    scatter: SlopeScatter
    ways: Array

    @cached_property
    def reasons(self) -> tuple[str, ...]:
        """Why the adjustment is refused, empty if it is not."""
        known = self.priors.known.is_stated
        return tuple(reasons(self.windows, self.solution, self.shares, self.determined, self._turned, known))

    def _turned(self, static: int, factor: float) -> Solution:
        turned, _ = excited_together(turned_windows(self.windows, static, factor))
        held = [e.pose for e in turned]
        return solve(Equations(self.data, held, self.priors, self.applied, self.scatter, self.ways), self.priors)


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """What the windows say of S and Q, what that rests on, and whether it may be used.

    `calibration` has NaN for a parameter that the data do not determine and of which nothing was known before; what was
    known of S and Q makes it the posterior. `contributions` {source: (12,) standard
    uncertainties} is the budget. `grounds`: what `reasons` is found from. `rank` of the input vectors, 4 at most.
    `offset_scatter_mps2`, `slope_scatter` (relative) and `lag_scatter_s`: between windows, as estimated.
    `common_lag_s`: the lag as it was before the windows were given lags of their own, None where it is no unknown: from
    a start that is far off they seem to differ, and the lag would not be found.
    `misfit`: what S a + Q leaves of the signal. `nuisance_pull`: how far the nuisances moved from what was stated, in
    standard deviations, worst direction. `mean` (N,) and `covariance` (N, N): joint state of [S, Q, nuisances], nothing
    blanked. `response`: over frequency; None where it is no unknown. `share`: what S and Q owe to the reference.
    `across`: the motion across a uniaxial reference that the data show, and what was taken out of the output along.
    """

    calibration: Calibration
    nuisances: tuple[Nuisance, ...]
    contributions: Mapping[str, Array]
    coverage_factor: float
    grounds: Grounds
    rank: int
    chi2: float
    chi2_degrees_of_freedom: float
    offset_scatter_mps2: float
    slope_scatter: float
    lag_scatter_s: float
    misfit: float
    nuisance_pull: float
    common_lag_s: float | None
    mean: Array
    covariance: Array
    response: ResponseTold | None
    share: ReferenceShare | None
    across: Across

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is refused, empty if it is not. Found when first asked: signs that contradict are tried out, which
        takes longer than the adjustment."""
        return self.grounds.reasons

    @property
    def expanded_uncertainty(self) -> Array:
        """(12,) for about 95 % coverage."""
        return self.coverage_factor * self.calibration.standard_uncertainty

    @property
    def joint(self) -> tuple[Array, Array] | None:
        """S and Q (12,) and their covariance (12, 12) with all that is known of combinations of elements of S, for the
        next adjustment's `Priors`: of a motion in a plane, S times the directions in it. NaN for Q where nothing is
        known of it.

        None where `calibration` says as much, and where the data are refused for another reason than that they
        determine nothing.
        """
        solution = self.grounds.solution
        hopeless = tuple(nothing_determined(solution, self.grounds.determined))
        if np.isfinite(self.calibration.sensitivity).all() or self.reasons not in ((), hopeless):
            return None
        values, covariance = self.mean[:12].copy(), self.covariance[:12, :12].copy()
        equations = solution.equations
        if not solution.bounded[:9].all():
            unexcited = UNKNOWN * equations.output_per_mps2 * equations.unexcited
            covariance[:9, :9] += np.kron(np.eye(3), unexcited.T @ unexcited)
        unknown = np.append(np.zeros(9, dtype=bool), ~np.isfinite(self.calibration.offset))
        values[unknown], covariance[unknown, :], covariance[:, unknown] = np.nan, np.nan, np.nan
        return values, covariance

    @property
    def lag_s(self) -> float | None:
        """By how much the sensor's indications come after the reference's; None where the lag is no unknown."""
        return next((n.value for n in self.nuisances if n.kind is LAG), None)

    @property
    def invariant(self) -> Array:
        """S S' (3, 3): what a rotation of the frame, which leaves no trace in the data, does not change."""
        return np.asarray(self.calibration.sensitivity @ self.calibration.sensitivity.T)


def adjust(windows: Sequence[Window], priors: Priors | None = None, applied: Applied | None = None) -> Adjustment:
    """Adjust all used windows together; their reference's noise is corrected for (see calib.windows.excited).

    `applied`: what the front end took out of the data beforehand. Raises ValueError where no window is used.
    """
    priors, applied = priors or Priors(), applied or Applied()
    used = [w for w in windows if w.used]
    if not used:
        raise ValueError("no window is used")
    stated = priors
    if never_turned(np.array([mean_input(w) for w in used])):
        priors = _without_offset(priors)
    plain = not any(priors.values.values())  # with every nuisance fixed it is Method 3: all points weigh the same
    found, ways = excited_together(used)
    across = Across() if plain else across_of(found, priors.transverse)
    if across.output is not None:  # what is left does not feel it
        found, ways = excited_together(across.taken_out(used))
        priors = priors.with_values({"transverse": 0.0})
    elif across.motion:
        priors = priors.with_values({"transverse": across.motion})
    model = priors.response_model
    to_hz, one = np.inf if model.one_frequency else model.to_hz, model.one_frequency
    data = condense(found, alike=plain, response_hz=to_hz, one_frequency=one, powers=model.powers)
    if not plain:
        data = replace(effective(data, np.array([w.independent for w in used])), telling=across.telling)
    u_lag_s = [max(w.u_lag_s, priors.lag_window_s) if priors.lag_s > 0.0 else 0.0 for w in used]
    noisy = np.array([padded(e.noise_shares.reshape(2, -1), data.channels).ravel() for e in found])
    scatter = SlopeScatter.of(data, u_lag_s, [e.window.u_noise for e in found], noisy)
    held = [e.pose for e in found]
    equations = partial(Equations, data, held, priors, applied, ways=ways)
    first = solve(equations(scatter), priors)
    solution, scatter = _with_scatter(first, scatter, equations, priors)
    shares = budget(solution, priors.offset_mps2, priors.known_u, across)
    mean, covariance = solution.x[:12], shares.covariance[:12, :12]
    prior_u = _prior_u(stated, solution.equations.output_per_mps2)
    seen = solution.equations.seen | solution.bounded  # what the data do not see, they may tell by combinations
    told = determined(mean, np.sqrt(np.diag(covariance)), prior_u, seen)
    known = told | np.isfinite(prior_u)
    values = np.where(known, mean, np.nan)
    k = coverage_factor(float(np.min(shares.degrees_of_freedom[told], initial=np.inf)))
    return Adjustment(
        calibration=Calibration(
            values[:9].reshape(3, 3),
            values[9:],
            np.where(np.outer(known, known), covariance, np.nan),
            told,
            data.type_a.degrees_of_freedom,
            "3 (adjustment)",
        ),
        nuisances=_reported(solution, shares),
        contributions=shares.contributions,
        coverage_factor=k,
        grounds=Grounds(used, solution, shares, told, data, priors, applied, scatter, ways),
        rank=solution.equations.rank,
        chi2=shares.consistency[0],
        chi2_degrees_of_freedom=shares.consistency[1],
        offset_scatter_mps2=shares.offset_scatter_mps2,
        slope_scatter=shares.slope_scatter,
        lag_scatter_s=float(scatter.lag_s.max()),
        misfit=misfit(solution),
        nuisance_pull=nuisance_pull(solution, shares.covariance)[0],
        common_lag_s=_lag_s(first),
        mean=solution.x,
        covariance=shares.covariance,
        response=_response(solution, shares.covariance, priors, used, k),
        share=share_after(solution),
        across=across,
    )


def _response(
    solution: Solution, covariance: Array, priors: Priors, windows: Sequence[Window], k: float
) -> ResponseTold | None:
    if not priors.response:
        return None
    model = priors.response_model
    band_hz = None if model.one_frequency else motion_band_hz(windows)
    if band_hz is None:  # of a broad motion: what is left of it once the response is taken out is too narrow
        band_hz = (model.to_hz if model.one_frequency else priors.reference_frequency_hz, model.to_hz)
    nuisances = solution.equations.nuisances
    own = np.flatnonzero([t.kind is RESPONSE for t in nuisances.terms])
    applied = np.array([nuisances.terms[j].applied for j in own])
    chosen = np.concatenate([np.arange(9), 12 + own])
    told = response_at_one_frequency if model.one_frequency else partial(response_of, from_hz=model.from_hz)
    return told(
        np.append(solution.x[:9], solution.x[12 + own] + applied),
        covariance[np.ix_(chosen, chosen)],
        nuisances.response[own],
        priors.reference_frequency_hz,
        band_hz,
        k,
        known=KnownResponses.of(priors),
    )


def _prior_u(priors: Priors, scale: float) -> Array:
    """(12,) standard uncertainties of S and Q before any data, inf where nothing was known: of an element of S, also
    where only combinations with others were known, so that it may be off by the sensor's scale."""
    if priors.parameters is None or priors.covariance is None:
        return np.full(12, np.inf)
    u = np.where(np.isfinite(priors.parameters), np.sqrt(np.diag(priors.covariance)), np.inf)
    u[:9] = np.where(u[:9] < scale, u[:9], np.inf)
    return np.asarray(u)


def _with_scatter(
    solution: Solution, scatter: SlopeScatter, equations: Callable[[SlopeScatter], Equations], priors: Priors
) -> tuple[Solution, SlopeScatter]:
    """The solution with the scatter of the slopes that its residuals show, and this scatter."""
    for _ in range(SCATTER_TURNS if priors.lag_s > 0.0 else 0):
        larger = estimated(scatter, *slope_residuals(solution), solution.equations.data.type_a.slopes)
        if larger.lag_s.max() <= (1.0 + SCATTER_SETTLED) * scatter.lag_s.max():
            break
        scatter = larger
        solution = solve(equations(scatter), priors)
    return solution, scatter


def _without_offset(priors: Priors) -> Priors:
    """What was known of Q left out: under a gravity that never turns it would be told of S, through the mean output."""
    if priors.parameters is None or priors.covariance is None:
        return priors
    covariance = priors.covariance.copy()
    covariance[9:, :], covariance[:, 9:] = 0.0, 0.0
    covariance[range(9, 12), range(9, 12)] = np.inf
    return replace(priors, covariance=covariance)


def _lag_s(solution: Solution) -> float | None:
    terms = zip(solution.equations.nuisances.terms, solution.x[12:], strict=True)
    return next((float(value) + term.applied for term, value in terms if term.kind is LAG), None)


def _reported(solution: Solution, shares: Budget) -> tuple[Nuisance, ...]:
    uncertainty = np.sqrt(np.diag(shares.covariance)[12:])
    return tuple(
        Nuisance(t.name, t.kind, float(value) + t.applied, float(u), t.uncertainty, t.unit)
        for t, value, u in zip(solution.equations.nuisances.terms, solution.x[12:], uncertainty, strict=True)
    )
