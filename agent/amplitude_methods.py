"""`fieldcal calibrate --method 1|2`: the paper's methods on amplitudes, from the windows of files."""

from __future__ import annotations

from typing import Any

import click
import numpy as np

from agent.frontend import FrontEnd
from agent.outcome import Outcome
from agent.priors import priors_of
from calib import method1, method2
from calib.amplitudes import AmplitudeCalibration, Run
from calib.model import PARAMETERS
from calib.statistics import rel_s_pct, transverse_excess

SOLVE = {"1": method1.solve, "2": method2.solve}
MAIN = (0, 4, 8)
# A main sensitivity this many standard uncertainties from its nominal value is another sensor, axis or reference; noise
# and priors alone do it once in 370 times.
CONTRADICTION = 3.0


def by_amplitudes(front: FrontEnd, options: dict[str, Any]) -> Outcome:
    """Method 1 or 2 on every used window in motion, windows of one position being repetitions.

    Raises click.UsageError where options belong to Method 3 alone.
    """
    for name in ("plain", "prior"):
        if options[name]:
            raise click.UsageError(f"--{name} belongs to Method 3")
    pairs = list(front.runs())
    windows = [window for _, window in pairs]
    # what the front end has made of a velocity is an acceleration already
    runs = [Run(p.time_s, p.u[:, 0], p.V, w.pose) for p, w in pairs if w.used and p.u.shape[1] == 1]
    method = options["method"]
    if not runs:
        return Outcome(None, ("no window can be used",), windows, front.sensor_clock.rate_hz, method)
    try:
        found = SOLVE[method](runs, priors_of(options))
    except ValueError as error:
        return Outcome(None, (str(error),), windows, front.sensor_clock.rate_hz, method)
    reasons = (*found.reasons, *_contradictions(found, options["nominal"], options["u_nominal_pct"]))
    omega = 2 * np.pi * found.frequency_hz
    return Outcome(
        calibration=None if reasons else found.calibration,
        reasons=reasons,
        windows=windows,
        rate_hz=front.sensor_clock.rate_hz,
        method=found.calibration.method,
        coverage_factor=found.coverage_factor,
        uncertainty_kind="GUM, types A and B",
        lag_s=-float(np.nanmean(np.diag(found.phase_rad))) / omega,
        statistics=_appendix_a(found),
        more={"frequency_hz": found.frequency_hz, "budget": found.statement.by_source},
    )


def _contradictions(found: AmplitudeCalibration, nominal: float | None, u_nominal_pct: float | None) -> list[str]:
    if nominal is None or u_nominal_pct is None:
        return []
    reasons = []
    u_nominal = u_nominal_pct / 100 * nominal
    for k in MAIN:
        value, u = found.calibration.sensitivity.ravel()[k], found.calibration.standard_uncertainty[k]
        away = abs(value - nominal) / np.hypot(u, u_nominal)
        if away > CONTRADICTION:
            reasons.append(
                f"{PARAMETERS[k]} is {value:.4g}, {away:.1f} standard uncertainties from the nominal {nominal:.4g} "
                f"(u {u_nominal:.3g}); {CONTRADICTION:g} at most"
            )
    return reasons


def _appendix_a(found: AmplitudeCalibration) -> dict[str, Any]:
    """Appendix A: by parameter one entry a run; rel_S where transverse sensitivities are seen."""
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
