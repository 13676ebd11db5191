"""Whether an adjustment may be used: rank, contradictions with what was known, signs that fit better turned, misfit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from calib.distributions import chi2_quantile
from calib.estimate.budget import Budget
from calib.estimate.gauss_newton import Flags, Solution
from calib.estimate.quantities import LAG
from calib.model import PARAMETERS, Array, Window

CONTRADICTED = 0.999  # probability: one sound calibration in a thousand is refused as contradicting what was known
PRIOR_SHARE = 0.01  # of a direction's prior variance that the data must have removed for it to be a test of the prior
# A turned sign "fits decisively better": the likelihood ratio exp(25 / 2) is 3e5 to 1, and it explains most of the
# misfit, so that no residual systematic effect of a right sign is taken for a wrong one.
DECISIVE_CHI2 = 25.0
DECISIVE_RATIO = 0.25
MISFIT_LIMIT = 0.1  # of the signal; the worst geometry met with right signs leaves 0.01
# What was stated of the nuisances is contradicted where it is so even with every stated uncertainty doubled: a clamp
# twice as bad as its default says is still used.
STATED_TIMES = 2.0
LEAST_FELT = 0.1  # of the largest sensitivity, that an output which works has in some direction
CONFOUNDED_LAG = 0.01  # of the largest sensitivity, that an undetermined lag puts into one of the others


def reasons(
    windows: Sequence[Window],
    solution: Solution,
    shares: Budget,
    determined: Flags,
    turned: Callable[[int, int], Solution],
) -> list[str]:
    """Why the adjustment is refused, each with its numbers; empty where it is not.

    `turned(static, polarity)` solves again with gravity times `static` and the reference times `polarity`.
    """
    return (
        _rank_reasons(windows, solution)
        or _sign_reasons(solution, turned)
        or _lag_reasons(solution, shares)
        or [*_prior_reasons(solution), *_misfit_reasons(solution)]
        or _nuisance_reasons(solution, shares.covariance)
        or _nothing_determined(solution, determined)
        or dead_reasons(np.where(determined, solution.x[:12], np.nan)[:9].reshape(3, 3))
    )


def _rank_reasons(windows: Sequence[Window], solution: Solution) -> list[str]:
    found, full = solution.equations.rank, 4
    clamped = all(w.pose.theta_rad is not None for w in windows)
    static = bool(solution.equations.known.any() and np.any(np.nan_to_num(solution.equations.nuisances.gravity)))
    if clamped and static and found < full:
        angles = len({(w.pose.theta_rad, w.pose.alpha_rad) for w in windows})
        return [
            f"rank {found} of {full}: {angles} clamp positions leave a direction unseen; three or more distinct alphas "
            "and a motion are needed"
        ]
    return []


def _nothing_determined(solution: Solution, determined: Flags) -> list[str]:
    if determined.any():
        return []
    if solution.bounded.any() and solution.equations.rank == 4:
        return ["the data add too little to what was known: no parameter's uncertainty is halved"]
    return [f"rank {solution.equations.rank} of 4: the data determine none of the 12 parameters"]


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
        f"rank {solution.equations.rank} of 4 with the lag fixed, one less with it: the motion cannot tell the lag "
        f"(u {after * 1e3:.3g} ms of {before * 1e3:.3g} ms before) from a rotation; it puts {moved:.1%} into S. "
        "Motion in a plane at one frequency does that: excite another frequency or direction"
    ]


def _sign_reasons(solution: Solution, turned: Callable[[int, int], Solution]) -> list[str]:
    # A poor fit turned may end anywhere; what it is judged by is its chi2 alone, over the rows that it has.
    if solution.chi2 <= chi2_quantile(CONTRADICTED, solution.residual.size) and not _prior_reasons(solution):
        return []
    tried = {
        "the static sign (gravity)": turned(-1, 1),
        "the polarity of the reference": turned(1, -1),
        "the static sign and the polarity of the reference": turned(-1, -1),
    }
    tried = {name: other for name, other in tried.items() if np.isfinite(other.chi2)}
    if not tried:
        return []
    best = min(other.chi2 for other in tried.values())
    # Where nothing was known of S, turning gravity and turning the reference fit alike; one of them leaves S positive.
    alike = [name for name, other in tried.items() if other.chi2 <= best + DECISIVE_CHI2]
    name = max(alike, key=lambda n: float(tried[n].x[[0, 4, 8]].sum()))
    if best > solution.chi2 - DECISIVE_CHI2 or best > DECISIVE_RATIO * solution.chi2:
        return []
    return [f"the data fit decisively better with {name} turned: chi-squared {best:.4g}, as stated {solution.chi2:.4g}"]


def _prior_reasons(solution: Solution) -> list[str]:
    """Does the estimate lie where what was known of S and Q allows? Tested where the data outweigh the prior."""
    known = np.flatnonzero(solution.bounded)
    if not known.size:
        return []
    before = np.linalg.inv(solution.prior_precision[np.ix_(known, known)])
    root = np.linalg.cholesky(before)
    pull = np.linalg.solve(root, solution.x[known] - solution.prior_mean[known])
    left = np.linalg.solve(root, np.linalg.solve(root, (solution.half[known] @ solution.half[known].T)).T)
    removed, ways = np.linalg.eigh(np.eye(len(known)) - left)
    tested = removed > PRIOR_SHARE
    statistic = float(np.sum((ways.T @ pull)[tested] ** 2 / removed[tested]))
    limit = chi2_quantile(CONTRADICTED, float(tested.sum()))
    if statistic <= limit or not tested.any():
        return []
    u = np.sqrt(np.diag(before))
    worst = int(np.argmax(np.abs(solution.x[known] - solution.prior_mean[known]) / u))
    p = known[worst]
    return [
        f"the data contradict what was known: chi-squared {statistic:.4g}, limit {limit:.4g} (of {int(tested.sum())}); "
        f"{PARAMETERS[p]} is {solution.x[p]:.5g}, {solution.prior_mean[p]:.5g} with u {u[worst]:.3g} was expected"
    ]


def nuisance_pull(solution: Solution, covariance: Array) -> tuple[float, float, str]:
    """How far the nuisances moved from what was stated, in the worst direction: in the standard deviations that they
    have beforehand, the limit, and the one that moved most. A lag is left out: the data alone tell it.

    With H the information and C the `covariance` (N, N), an estimate strays from its prior's mean by P^-1 - 2 H^-1 + C.
    """
    terms = solution.equations.nuisances.terms
    stated = [j for j, t in enumerate(terms) if t.kind.stated]
    if not stated:
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
    told = f"{term.name} would be off by {moved:.3g} {term.unit}, its standard uncertainty was stated as {u[worst]:.3g}"
    limit = STATED_TIMES * float(np.sqrt(chi2_quantile(single, 1.0)))
    return float(found.max(initial=0.0)), limit, told


def _nuisance_reasons(solution: Solution, covariance: Array) -> list[str]:
    found, limit, told = nuisance_pull(solution, covariance)
    if found <= limit:
        return []
    return [f"the data contradict what was stated: {told} ({found:.3g} standard deviations, limit {limit:.3g})"]


def dead_reasons(sensitivity: Array) -> list[str]:
    """Outputs (rows of S) that hardly feel anything. NaN where not determined.

    Axes that are exchanged are no fault by themselves: S says so, and only what was known beforehand contradicts it.
    """
    size = np.abs(sensitivity)
    largest = float(np.nanmax(size, initial=0.0))
    felt = np.nanmax(size, axis=1, initial=0.0)
    told = [bool(np.isfinite(row).all()) for row in size]
    return [
        f"output {axis} is dead: its largest sensitivity is {felt[i]:.4g}, that of the others {largest:.4g}"
        for i, axis in enumerate("xyz")
        if told[i] and felt[i] < LEAST_FELT * largest
    ]


def _misfit_reasons(solution: Solution) -> list[str]:
    found = misfit(solution)
    if found <= MISFIT_LIMIT:
        return []
    return [f"S a + Q leaves {found:.1%} of the signal between windows unexplained (limit {MISFIT_LIMIT:.0%})"]


def misfit(solution: Solution) -> float:
    """Root mean square of what the solution leaves of slopes and means over that of the signal, beyond noise."""
    equations = solution.equations
    data, noise = equations.data, equations.data.type_a.noise
    slope, mean = equations.split(solution.residual)
    parts = [(slope * noise[:, None], data.slopes, np.broadcast_to(noise[:, None], slope.shape))]
    weight = np.where(equations.mean_weight > 0.0, equations.mean_weight, np.inf)
    root = np.sqrt(data.count)[:, None]
    held = equations.known
    if np.ptp(np.nan_to_num(equations.nuisances.gravity)[equations.pose_of_window], axis=0).any():
        centred = data.mean_v - data.count @ data.mean_v / data.count.sum()
        parts.append(((mean / weight * root)[held], (centred * root)[held], noise[held]))
    shares = [0.0]
    for left, signal, sd in parts:
        power = float((signal**2).sum())
        if power > 0.0:
            shares.append(max(float((left**2 - sd**2).sum()), 0.0) / power)
    return float(np.sqrt(max(shares)))


def turned_windows(windows: Sequence[Window], static: int, polarity: int) -> list[Window]:
    """The same windows with gravity and the reference's direction in every pose multiplied by these signs."""
    return [
        replace(
            w,
            pose=replace(w.pose, direction=polarity * w.pose.direction, gravity_mps2=static * w.pose.gravity_mps2),
        )
        for w in windows
    ]
