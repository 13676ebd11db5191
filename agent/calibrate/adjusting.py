"""`fieldcal calibrate` without --plain: the adjustment of all windows, and the norm fit if there are only rests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from agent.calibrate.files import Files
from agent.calibrate.outcome import NuisanceValue, Outcome, nothing_used
from agent.calibrate.priors import priors_of, row_contradictions, u_gravity_mps2
from agent.calibrate.tables import SensorTable
from calib.estimate.adjustment import Adjustment, adjust
from calib.estimate.lag_search import without_lag
from calib.estimate.norm_fit import norm_fit
from calib.estimate.nuisances import Applied, Priors
from calib.excitation.windows import rests_anywhere
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import PARAMETERS, Window
from calib.signal.stamps import clock_from_stamps


def adjusted(files: Files, priors: Priors) -> Outcome:
    """Make windows with the lag taken out, and adjust them."""
    applied = Applied(0.0, priors.reference_corner_at_hz, priors.sensor_corner_at_hz)
    latest: dict[float, Adjustment] = {}  # key: the lag that was taken out

    def at(windows: Sequence[Window], lag_s: float) -> Adjustment:
        if lag_s not in latest:
            latest.clear()
            latest[lag_s] = adjust(_used(windows), priors, replace(applied, lag_s=lag_s))
        return latest[lag_s]

    windows, lag_s = without_lag(applied.lag_s, files.windows, _used, lambda made, lag_s: at(made, lag_s).lag_s or 0.0)
    if not _used(windows):
        return nothing_used(windows, files.rate_hz, "3 (adjustment)")
    return _outcome(at(windows, lag_s), windows, files.rate_hz)


def _used(windows: Sequence[Window]) -> list[Window]:
    return [w for w in windows if w.used]


def norm_fitted(sensor: SensorTable, options: dict[str, Any]) -> Outcome:
    """Fit to rests that are found in the sensor's file. Only the magnitude of gravity is known, so the frame is free
    and S is upper triangular.

    Raises TableError if --prior cannot be read.
    """
    priors = priors_of(options)
    clock = clock_from_stamps(sensor.time_s)
    gravity = options["gravity_mps2"] or STANDARD_GRAVITY_MPS2
    there = np.flatnonzero(np.isfinite(sensor.v).all(axis=1))
    windows = rests_anywhere(clock.time_of(there), np.asarray(sensor.v)[there], gravity)
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
        lag_s=found.lag_s,
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
