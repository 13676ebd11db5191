"""Checks of an adjustment: rank, contradictions of priors and stated values, reversed signs, misfit, and S itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from calib.adjustment.budget import Budget
from calib.adjustment.mistakes import FACTORS, of_a_prior, of_means, with_unit
from calib.adjustment.solution import Solution
from calib.distributions import chi2_quantile, coverage_factor
from calib.estimate.axes import LEAST_S, sensitivity_reasons, silent_directions
from calib.estimate.determined import Flags
from calib.estimate.quantities import LAG
from calib.model import PARAMETERS, Array, Calibration, Window

CONTRADICTED = 0.999  # probability: one sound calibration in a thousand is refused as a contradiction of its priors
PRIOR_SHARE = 0.01  # a prior is tested only in directions in which the data reduce its variance by this part
# A reversed sign fits "decisively better" if the likelihood ratio is above exp(25 / 2) = 3e5 to 1 and it also removes
# most of chi-squared. So a systematic effect under the right sign is not taken for a wrong sign.
DECISIVE_CHI2 = 25.0
DECISIVE_RATIO = 0.25
MISFIT_LIMIT = 0.1  # of the signal; with right signs, 0.01 was left in the worst geometry
# A stated value is contradicted only if the data contradict it even with every stated standard uncertainty doubled: a
# clamp whose errors are twice its default uncertainty is still used.
STATED_TIMES = 2.0
MOST_BETWEEN_BANDS = 0.01  # relative; a pair that is far apart, or turned, deviates by several per cent
GROSS = 10.0  # chi-squared over its expectation; another unit or a resonance gives a hundred and more
CONFOUNDED_LAG = 0.01  # largest error of S due to an undetermined lag, relative to the scale of S


def reasons(
    windows: Sequence[Window],
    solution: Solution,
    shares: Budget,
    determined: Flags,
    turned: Callable[[int, float], Solution],
    known_filters: bool,
) -> list[str]:
    """The reasons why the adjustment is refused, each with its numbers; empty if it is accepted.

    `turned(static, factor)` solves again with gravity multiplied by the sign `static` and the reference by `factor`.
    `known_filters`: those of sensor and reference are stated, so that the data may contradict them.
    """
    return (
        _number_reasons(solution, shares.covariance)
        or _rank_reasons(windows, solution)
        or _sign_reasons(solution, turned)
        or _unit_reasons(solution, turned)
        or _lag_reasons(solution, shares)
        or response_reasons(shares)
        or [*_prior_reasons(solution), *_misfit_reasons(solution)]
        or _nuisance_reasons(solution, shares.covariance)
        or (_filter_reasons(solution) if known_filters else [])
        or nothing_determined(solution, determined)
        or _sensitivity_reasons(solution, shares, determined)
        or _short_reasons(windows)
    )


def _number_reasons(solution: Solution, covariance: Array) -> list[str]:
    if np.isfinite(solution.chi2) and np.isfinite(covariance).all():
        return []
    return [
        "the equations have no solution in numbers: something that they divide by is zero; measure longer, with more "
        "motion or in more positions"
    ]


def _sensitivity_reasons(solution: Solution, shares: Budget, determined: Flags) -> list[str]:
    known = determined | solution.bounded
    values = np.where(known, solution.x[:12], np.nan)
    covariance = np.where(np.outer(known, known), shares.covariance[:12, :12], np.nan)
    found = Calibration(values[:9].reshape(3, 3), values[9:], covariance, determined, np.inf, "")
    k = coverage_factor(float(np.min(shares.degrees_of_freedom[determined], initial=np.inf)))
    return sensitivity_reasons(found, k, stated=bool(solution.bounded[:9].any()))


def _short_reasons(windows: Sequence[Window]) -> list[str]:
    length_s = sum(w.stop_s - w.start_s for w in windows)
    if len(windows) > 1 or length_s >= LEAST_S:
        return []
    return [
        f"only one window of {length_s:.3g} s can be used; two windows, or {LEAST_S:g} s, are needed to see whether "
        "the data agree with each other: measure longer"
    ]


def _rank_reasons(windows: Sequence[Window], solution: Solution) -> list[str]:
    found, full = solution.equations.rank, 4
    clamped = all(w.pose.theta_rad is not None for w in windows)
    static = bool(solution.equations.known.any() and np.any(solution.equations.gravity_mps2))
    if clamped and static and found < full:
        angles = len({(w.pose.theta_rad, w.pose.alpha_rad) for w in windows})
        return [
            f"rank {found} of {full}: {angles} clamp positions leave a direction without excitation; measure with at "
            "least three different alphas, and with motion"
        ]
    return []


def nothing_determined(solution: Solution, determined: Flags) -> list[str]:
    """The reason why the data determine none of the parameters; empty where they determine one."""
    if determined.any():
        return []
    equations = solution.equations
    if solution.bounded.any() and equations.rank == 4:
        return [
            "the data add too little to the priors: they halve the standard uncertainty of no parameter; "
            "measure longer, with more motion or in more positions"
        ]
    where = silent_directions(equations.unexcited)
    return [
        f"rank {equations.rank} of 4: the data determine none of the 12 parameters"
        f"{': ' if where else ''}{where}; measure with more motion or in more positions"
    ]


def _lag_reasons(solution: Solution, shares: Budget) -> list[str]:
    terms = solution.equations.nuisances.terms
    j = next((j for j, t in enumerate(terms) if t.kind is LAG), None)
    if j is None:
        return []
    after, before = float(np.sqrt(shares.covariance[12 + j, 12 + j])), terms[j].uncertainty
    seen = solution.equations.seen[:9]
    moved = float(shares.contributions[LAG.source][:9][seen].max(initial=0.0)) / solution.equations.output_per_mps2
    if after <= 0.5 * before or moved <= CONFOUNDED_LAG:
        return []
    return [
        f"rank {solution.equations.rank} of 4 with the lag fixed, one less with a free lag: the data cannot "
        f"distinguish the lag from a rotation (u(lag) is {after * 1e3:.3g} ms, {before * 1e3:.3g} ms before the data), "
        f"and u(lag) alone gives S a standard uncertainty of {moved:.1%}, limit {CONFOUNDED_LAG:.0%}. This happens "
        "with motion in a plane at one frequency: excite another frequency or direction"
    ]


def response_reasons(shares: Budget, most: float = MOST_BETWEEN_BANDS) -> list[str]:
    """Whether bands of frequency deviate from one smooth response by more than the share `most`."""
    bands = shares.between_bands
    if bands.relative_u <= most:
        return []
    return [
        f"no smooth response over frequency explains the bands: they deviate by {bands.relative_u:.1%}, limit "
        f"{100.0 * most:.2g}%, and most of it comes from {bands.at_hz:.3g} Hz; look there for a resonance, a "
        "filter's edge, a source of noise or a loose mount, or calibrate with motion that leaves this band out"
    ]


def _contradicted(solution: Solution) -> bool:
    return solution.chi2 > chi2_quantile(CONTRADICTED, solution.residual.size) or bool(_prior_reasons(solution))


def _unit_reasons(solution: Solution, turned: Callable[[int, float], Solution]) -> list[str]:
    if not (_contradicted(solution) and solution.chi2 > GROSS * solution.residual.size):
        return []
    tried = {factor: turned(1, factor) for factor in FACTORS}
    fits = {
        factor: other.chi2
        for factor, other in tried.items()
        if np.isfinite(other.chi2) and misfit(other) <= MISFIT_LIMIT and not _contradicted(other)
    }
    if not fits or min(fits.values()) > solution.chi2 - DECISIVE_CHI2:
        return []
    factor = min(fits, key=lambda f: fits[f])
    return [
        f"the data fit if the reference is multiplied by {factor:.4g}: chi-squared {fits[factor]:.4g}, as stated "
        f"{solution.chi2:.4g}; {FACTORS[factor]}: state its unit, or convert it to m/s2"
    ]


def _sign_reasons(solution: Solution, turned: Callable[[int, float], Solution]) -> list[str]:
    # With reversed signs a poor fit may end anywhere, so only chi2 and the misfit of such a fit are looked at.
    if not _contradicted(solution):
        return []
    tried = {
        "the static sign (gravity)": turned(-1, 1),
        "the polarity of the reference": turned(1, -1),
        "the static sign and the polarity of the reference": turned(-1, -1),
    }
    tried = {name: other for name, other in tried.items() if np.isfinite(other.chi2) and misfit(other) <= MISFIT_LIMIT}
    if not tried:
        return []
    best = min(other.chi2 for other in tried.values())
    # Without a prior of S, reversing gravity and reversing the reference fit equally well; one of them makes the
    # diagonal of S positive, and that one is reported.
    alike = [name for name, other in tried.items() if other.chi2 <= best + DECISIVE_CHI2]
    name = max(alike, key=lambda n: float(tried[n].x[[0, 4, 8]].sum()))
    if best > solution.chi2 - DECISIVE_CHI2 or best > DECISIVE_RATIO * solution.chi2:
        return []
    return [
        f"the data fit decisively better with {name} reversed: chi-squared {best:.4g}, as stated {solution.chi2:.4g}; "
        "check these signs and the directions of the axes"
    ]


def _prior_reasons(solution: Solution) -> list[str]:
    """Whether the estimate contradicts the prior of S and Q; tested in the directions that the data determine."""
    known = np.flatnonzero(solution.bounded)
    if not known.size:
        return []
    precision, axes = np.linalg.eigh(solution.prior_precision[np.ix_(known, known)])
    inverse = np.sqrt(precision)[:, None] * axes.T  # of a factor of the covariance before
    pull = inverse @ (solution.x[known] - solution.prior_mean[known])
    left = inverse @ solution.half[known]
    removed, ways = np.linalg.eigh(np.eye(len(known)) - left @ left.T)
    tested = removed > PRIOR_SHARE
    statistic = float(np.sum((ways.T @ pull)[tested] ** 2 / removed[tested]))
    limit = chi2_quantile(CONTRADICTED, float(tested.sum()))
    if statistic <= limit or not tested.any():
        return []
    u = np.linalg.norm(axes / np.sqrt(precision), axis=1)
    worst = int(np.argmax(np.abs(solution.x[known] - solution.prior_mean[known]) / u))
    p = known[worst]
    S, S_known = (values[:9].reshape(3, 3) for values in (solution.x, solution.prior_mean))
    mistake = of_a_prior(S, S_known, of_offset=bool(p >= 9))
    return [
        f"the data contradict the prior of S and Q: chi-squared {statistic:.4g}, limit {limit:.4g} "
        f"({int(tested.sum())} degrees of freedom); {PARAMETERS[p]} is {solution.x[p]:.5g}, "
        f"{solution.prior_mean[p]:.5g} with u {u[worst]:.3g} was expected; check the prior and how the axes are mounted"
        f"{mistake}"
    ]


def nuisance_pull(solution: Solution, covariance: Array) -> tuple[float, float, str]:
    """The largest deviation of the nuisances from their stated values, its limit, and a sentence on the worst nuisance.

    The deviation is in standard deviations, in the worst direction. A lag is not tested, because nobody states it; only
    the data determine it. With P the precision of the priors, H the information and C the `covariance` (N, N), the
    covariance of an estimate's deviation from its prior's mean is P^-1 - 2 H^-1 + C.
    """
    terms = solution.equations.nuisances.terms
    stated = [j for j, t in enumerate(terms) if t.kind.stated]
    if not stated or _number_reasons(solution, covariance):
        return 0.0, np.inf, ""
    u, k = np.array([terms[j].uncertainty for j in stated]), 12 + np.array(stated)
    pull = (solution.x[k] - solution.prior_mean[k]) / u
    twice = 2.0 * solution.half[k] @ solution.half[k].T - covariance[np.ix_(k, k)]
    strays, ways = np.linalg.eigh(np.eye(len(k)) - twice / np.outer(u, u))
    tested = strays > PRIOR_SHARE
    found = np.abs(ways.T @ pull)[tested] / np.sqrt(strays[tested])
    single = 1.0 - (1.0 - CONTRADICTED) / max(len(found), 1)
    worst = int(np.argmax(np.abs(pull)))
    term, moved = terms[stated[worst]], pull[worst] * u[worst]
    told = (
        f"{term.name} would be off by {with_unit(moved, term.unit)}, its standard uncertainty was stated as "
        f"{with_unit(u[worst], term.unit)}"
    )
    limit = STATED_TIMES * float(np.sqrt(chi2_quantile(single, 1.0)))
    return float(found.max(initial=0.0)), limit, told


def _filter_reasons(solution: Solution) -> list[str]:
    """Whether the data contradict the filters that are stated: with a resonance, slopes on u and on du/dt have no S and
    no lag in common, whatever their size."""
    limit = GROSS * solution.residual.size
    if solution.chi2 <= limit:
        return []
    return [
        f"the data contradict the stated filters of sensor and reference: chi-squared {solution.chi2:.4g}, limit "
        f"{limit:.4g}; look for a resonance or another filter, and calibrate with motion at lower frequencies"
    ]


def _nuisance_reasons(solution: Solution, covariance: Array) -> list[str]:
    found, limit, told = nuisance_pull(solution, covariance)
    if found <= limit:
        return []
    return [
        f"the data contradict the stated values: {told} ({found:.3g} standard deviations, limit {limit:.3g}); "
        "check the stated value, or state a larger uncertainty"
    ]


def _misfit_reasons(solution: Solution) -> list[str]:
    found = misfit(solution)
    if found <= MISFIT_LIMIT:
        return []
    return [
        f"S a + Q leaves {found:.1%} of the signal between windows unexplained (limit {MISFIT_LIMIT:.0%}); "
        f"check that each position was stated as it was{of_means(_left_of_means(solution))}"
    ]


def _left_of_means(solution: Solution) -> Array:
    """(W, 3) what the windows' means differ by from S a + Q, in m/s2."""
    equations = solution.equations
    _, mean = equations.split(solution.residual)
    weight = np.where(equations.mean_weight > 0.0, equations.mean_weight, np.inf)
    return np.asarray(mean / weight / equations.output_per_mps2)


def misfit(solution: Solution) -> float:
    """Rms of the residuals of slopes or means beyond their noise, relative to the rms of the signal; the larger one."""
    equations = solution.equations
    data, noise = equations.data, equations.data.type_a.noise
    slope, mean = equations.split(solution.residual)
    told = data.slopes * data.telling
    parts = [(slope * noise[:, None], told, np.broadcast_to(noise[:, None] * data.telling, slope.shape))]
    weight = np.where(equations.mean_weight > 0.0, equations.mean_weight, np.inf)
    root = np.sqrt(data.count)[:, None]
    held = equations.known
    if np.ptp(equations.gravity_mps2, axis=0).any():
        centred = data.mean_v - data.count @ data.mean_v / data.count.sum()
        parts.append(((mean / weight * root)[held], (centred * root)[held], noise[held]))
    shares = [0.0]
    for left, signal, sd in parts:
        power = float((signal**2).sum())
        if power > 0.0:
            shares.append(max(float((left**2 - sd**2).sum()), 0.0) / power)
    return float(np.sqrt(max(shares)))


def turned_windows(windows: Sequence[Window], static: int, factor: float) -> list[Window]:
    """The same windows with gravity multiplied by the sign `static` and the reference by `factor`."""
    return [
        replace(
            w,
            pose=replace(w.pose, direction=factor * w.pose.direction, gravity_mps2=static * w.pose.gravity_mps2),
        )
        for w in windows
    ]
