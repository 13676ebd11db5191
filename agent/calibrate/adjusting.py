"""`fieldcal calibrate` without --plain: the adjustment of all windows, and the norm fit where only rests are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from agent.calibrate.frontend import FrontEnd
from agent.calibrate.outcome import NuisanceValue, Outcome, nothing_used
from agent.calibrate.priors import priors_of, row_contradictions, u_gravity_mps2
from agent.calibrate.tables import SensorTable
from calib.estimate.adjustment import Adjustment, adjust
from calib.estimate.norm_fit import norm_fit
from calib.estimate.nuisances import Applied, Priors
from calib.excitation.windows import rests_anywhere
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import PARAMETERS, Window
from calib.signal.stamps import clock_from_stamps

PASSES = 4
# Of a lag that the windows still have: (omega lag)^3 / 6 is what the adjustment's own second order leaves of it.
PHASE_LEFT = 1e-5
# Part of the loud power that calm windows must have before it is taken out: it attenuates S by as much.
QUIET_MATTERS = 1e-4
LEAST_QUIET_S = 5.0  # of calm a position, else its power is known worse than it matters


def adjusted(front: FrontEnd, priors: Priors) -> Outcome:
    """Solve, take out the lag that was found, repeat until what is left of it is nothing."""
    applied = Applied(0.0, priors.reference_corner_at_hz, priors.sensor_corner_at_hz)
    for _ in range(PASSES):
        windows = front.windows(applied.lag_s)
        used = [w for w in windows if w.used]
        if not used:
            return nothing_used(windows, front.sensor_clock.rate_hz, "3 (adjustment)")
        calm = _telling([w for w in windows if w.kind == "quiet"], used)
        if calm and front.band_hz is None and front.limit_band(used, calm):
            windows = front.windows(applied.lag_s)
            used = [w for w in windows if w.used]
            calm = _telling([w for w in windows if w.kind == "quiet"], used)
        found = adjust(used, priors, applied, calm)
        left = _lag(found) - applied.lag_s
        if abs(_omega(used) * left) ** 3 / 6.0 < PHASE_LEFT:
            break
        applied = replace(applied, lag_s=_lag(found))
    outcome = _outcome(found, windows, front.sensor_clock.rate_hz)
    return replace(outcome, more={**outcome.more, "band_hz": front.band_hz})


def norm_fitted(sensor: SensorTable, options: dict[str, Any]) -> Outcome:
    """Rests found in the sensor's file, gravity's magnitude all that is known: S upper triangular, the frame free.

    Raises TableError where --prior cannot be read.
    """
    priors = priors_of(options)
    clock = clock_from_stamps(sensor.time_s)
    gravity = options["gravity_mps2"] or STANDARD_GRAVITY_MPS2
    windows = rests_anywhere(clock.time_of(np.arange(len(sensor.time_s))), np.asarray(sensor.v), gravity)
    try:
        found = norm_fit(windows, gravity, u_gravity_mps2(options))
    except ValueError as error:
        return Outcome(None, (str(error),), windows, clock.rate_hz, "norm fit", more={"frame": "free"})
    reasons = (*found.reasons, *row_contradictions(found.calibration, priors))
    return Outcome(
        None if reasons else found.calibration, reasons, windows, clock.rate_hz, "norm fit",
        coverage_factor=found.coverage_factor,
        uncertainty_kind="scatter of the rests and u of gravity",
        more={"frame": "free", "residual_mps2": found.residual_mps2},
    )  # fmt: skip


def _outcome(found: Adjustment, windows: Sequence[Window], rate_hz: float) -> Outcome:
    nuisances = [NuisanceValue(n.name, n.value, n.standard_uncertainty, n.unit) for n in found.nuisances]
    return Outcome(
        None if found.reasons else found.calibration, found.reasons, windows, rate_hz, found.calibration.method,
        coverage_factor=found.coverage_factor,
        uncertainty_kind="combined",
        nuisances=nuisances,
        lag_s=_lag(found) if any(n.name == "lag" for n in found.nuisances) else None,
        rank=found.rank,
        more={
            "frame": "stated",
            "budget": {
                source: dict(zip(PARAMETERS, u, strict=True)) for source, u in found.contributions.items() if u.any()
            },
            "chi2": found.chi2,
            "chi2_degrees_of_freedom": found.chi2_degrees_of_freedom,
            "offset_scatter_mps2": found.offset_scatter_mps2,
            "slope_scatter": found.slope_scatter,
            "lag_scatter_s": found.lag_scatter_s,
            "misfit": found.misfit,
            "nuisance_pull": found.nuisance_pull,
            "invariant": None if found.reasons else found.invariant,
        },
    )  # fmt: skip


def _lag(found: Adjustment) -> float:
    return next((n.value for n in found.nuisances if n.name == "lag"), 0.0)


def _omega(windows: Sequence[Window]) -> float:
    """Largest angular frequency (rad/s) that any window's power stands for; 0 at rest."""
    largest = 0.0
    for window in windows:
        m, power = window.sums.reference_channels, np.diag(window.sums.scatter.sum(axis=0))
        if m and power[:m].sum() > 0.0:
            largest = max(largest, float(np.sqrt(power[m : 2 * m].sum() / power[:m].sum())))
    return largest


def _telling(quiet: Sequence[Window], loud: Sequence[Window]) -> list[Window]:
    """The calm windows of positions where the reference's noise matters and calm lasts long enough to know it."""
    kept: list[Window] = []
    for position in dict.fromkeys(w.pose.position for w in loud):
        calm = [w for w in quiet if w.pose.position == position and w.points > 1]
        if sum(w.stop_s - w.start_s for w in calm) < LEAST_QUIET_S:
            continue
        if _power(calm) > QUIET_MATTERS * _power([w for w in loud if w.pose.position == position]):
            kept += calm
    return kept


def _power(windows: Sequence[Window]) -> float:
    """Mean square of the reference's channels about their means in each segment, m2/s4."""
    m = max(w.sums.reference_channels for w in windows)
    total = sum(float(np.trace(w.sums.scatter.sum(axis=0)[:m, :m])) for w in windows)
    return total / sum(w.points for w in windows)
