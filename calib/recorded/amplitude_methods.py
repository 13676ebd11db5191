"""`method` 1 and 2: the paper's methods on amplitudes, from the windows of tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.estimate.axes import sensitivity_reasons
from calib.model import PARAMETERS
from calib.paper import method1, method2
from calib.paper.amplitudes import AmplitudeCalibration, SineRun
from calib.paper.statistics import rel_s_pct, transverse_excess
from calib.recorded.errors import OptionError
from calib.recorded.options import Options
from calib.recorded.outcome import Outcome, nothing_used
from calib.recorded.priors import contradictions, priors_of
from calib.recorded.tables import Tables

SOLVE = {1: method1.solve, 2: method2.solve}


def by_amplitudes(tables: Tables, options: Options) -> Outcome:
    """Method 1 or 2 on every used window with motion. Windows of one position are repetitions.

    Raises OptionError for a tri-axial reference.
    """
    priors = priors_of(options)
    pairs = list(tables.runs())
    windows = [window for _, window in pairs]
    # the front end has already converted a velocity to an acceleration
    method = options.method
    if any(p.u.shape[1] != 1 for p, _ in pairs):
        raise OptionError(
            f"`method` {method} needs a uniaxial `reference`, but this one is tri-axial", "use `method` 3"
        )
    runs = [SineRun(p.time_s, p.u[:, 0], p.V, w.pose) for p, w in pairs if w.used]
    if not runs:
        return nothing_used(windows, tables.rate_hz, str(method))
    try:
        found = SOLVE[method](runs, priors)
    except ValueError as error:
        return Outcome(None, (str(error),), windows, tables.rate_hz, str(method))
    reasons = (
        *found.reasons,
        *sensitivity_reasons(found.calibration, found.coverage_factor, stated=priors.parameters is not None),
        *contradictions(found.calibration, priors),
    )
    omega = 2 * np.pi * found.frequency_hz
    return Outcome(
        calibration=None if reasons else found.calibration,
        reasons=reasons,
        windows=windows,
        rate_hz=tables.rate_hz,
        method=found.calibration.method,
        coverage_factor=found.coverage_factor,
        uncertainty_kind="GUM, types A and B",
        lag_s=-float(np.nanmean(np.diag(found.phase_rad))) / omega,
        statistics=_appendix_a(found),
        more={"frequency_hz": found.frequency_hz, "budget": found.statement.by_source},
    )


def _appendix_a(found: AmplitudeCalibration) -> dict[str, Any]:
    """Appendix A: for each parameter one entry per run; rel_S if transverse sensitivities are determined."""
    statistics: dict[str, Any] = {
        PARAMETERS[3 * i + j]: [
            {"n": r.n, "mean": r.mean, "standard_deviation": r.standard_deviation, "s_rel_pct": r.s_rel_pct}
            for r in runs
        ]
        for (i, j), runs in found.repeatability.items()
    }
    S = found.calibration.sensitivity
    if np.isfinite(S[~np.eye(3, dtype=bool)]).any():
        statistics["rel_S_pct"] = rel_s_pct(S)
        statistics["beyond_5_pct"] = transverse_excess(S)
    return statistics
