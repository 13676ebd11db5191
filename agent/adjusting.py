"""`fieldcal calibrate` without `--plain`: windows, lag and adjustment in turn; rests alone by the norm fit."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.frontend import FrontEnd
from agent.outcome import NuisanceValue, Outcome
from agent.tables import SensorTable, TableError
from calib.adjustment import Adjustment, adjust
from calib.excitation import rests_anywhere
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import Array, Window
from calib.norm_fit import norm_fit
from calib.nuisances import Applied, Priors
from calib.stamps import clock_from_stamps

U_STANDARD_GRAVITY_MPS2 = 0.03  # where on Earth is not known
# A lag is taken out of the windows until what is left costs nothing: 20 us at 8 Hz put 5e-7 into S at the second order.
LAG_LEFT_S = 2e-5
LAG_TURNS = 4
TRANSVERSE_OF_NOMINAL = 0.03  # standard uncertainty of a transverse sensitivity that a data sheet calls zero
METHOD = "3 (adjustment)"


def adjusted(front: FrontEnd, options: dict[str, Any]) -> Outcome:
    """S, Q and nuisances of the files. Raises TableError where the prior's file cannot be used."""
    priors = priors_of(options)
    lag_s = 0.0
    for _ in range(LAG_TURNS):
        windows = front.windows(lag_s)
        if not any(w.used for w in windows):
            return Outcome(None, ("no window can be used",), windows, front.sensor_clock.rate_hz, METHOD)
        quiet = [w for w in windows if w.kind == "quiet"]
        found = adjust(windows, priors, Applied(lag_s=lag_s), quiet)
        lag = next((n.value for n in found.nuisances if n.name == "lag"), lag_s)
        if abs(lag - lag_s) < LAG_LEFT_S:
            break
        lag_s = lag
    return _outcome(found, windows, front.sensor_clock.rate_hz)


def _outcome(found: Adjustment, windows: list[Window], rate_hz: float) -> Outcome:
    nuisances = [NuisanceValue(n.name, n.value, n.standard_uncertainty, n.unit) for n in found.nuisances]
    return Outcome(
        calibration=None if found.reasons else found.calibration,
        reasons=found.reasons,
        windows=windows,
        rate_hz=rate_hz,
        method=METHOD,
        coverage_factor=found.coverage_factor,
        nuisances=nuisances,
        lag_s=next((n.value for n in nuisances if n.name == "lag"), None),
        rank=found.rank,
        more={
            "frame": "stated",
            "budget": {source: u.tolist() for source, u in found.contributions.items()},
            "invariant": found.invariant,
        },
    )


def from_rests(sensor: SensorTable, options: dict[str, Any]) -> Outcome:
    """Rests found in the file and gravity's magnitude: S upper triangular, the frame free."""
    gravity, u_gravity = gravity_of(options)
    clock = clock_from_stamps(sensor.time_s)
    windows = rests_anywhere(clock.time_of(np.arange(len(sensor.time_s))), np.asarray(sensor.v), gravity)
    method = "norm fit (frame free)"
    try:
        found = norm_fit(windows, gravity, u_gravity)
    except ValueError as error:
        return Outcome(None, (str(error),), windows, clock.rate_hz, method, more={"frame": "free"})
    return Outcome(
        calibration=None if found.reasons else found.calibration,
        reasons=found.reasons,
        windows=windows,
        rate_hz=clock.rate_hz,
        method=method,
        coverage_factor=found.coverage_factor,
        more={"frame": "free", "residual_mps2": found.residual_mps2},
    )


def gravity_of(options: dict[str, Any]) -> tuple[float, float]:
    """Gravity and its standard uncertainty, m/s2."""
    stated, u = options["gravity_mps2"], options["u_gravity_mps2"]
    if u is None:
        u = U_STANDARD_GRAVITY_MPS2 if stated is None else 0.0
    return (STANDARD_GRAVITY_MPS2 if stated is None else stated), u


def priors_of(options: dict[str, Any]) -> Priors:
    """The stated standard uncertainties, and what was known of S and Q. Raises TableError."""
    priors = Priors(
        angle_rad=math.radians(options["u_angle_deg"]),
        theta_rad=math.radians(options["u_theta_deg"]),
        theta_position_rad=math.radians(options["u_theta_position_deg"]),
        alpha_common_rad=math.radians(options["u_alpha_common_deg"]),
        offset_mps2=options["u_offset_mps2"],
        offset_position_mps2=options["u_offset_position_mps2"],
        reference=options["u_reference_pct"] / 100.0,
        transverse=options["u_transverse_motion_pct"] / 100.0,
        tilt_rad=math.radians(options["u_tilt_deg"]),
        rotation_rad=math.radians(options["u_rotation_deg"]),
        gravity_mps2=gravity_of(options)[1],
    )
    if options["nominal"] is not None:
        u = np.full((3, 3), TRANSVERSE_OF_NOMINAL * options["nominal"])
        np.fill_diagonal(u, options["u_nominal_pct"] / 100.0 * options["nominal"])
        known = np.append((options["nominal"] * np.eye(3)).ravel(), np.zeros(3))
        return replace(priors, parameters=known, covariance=np.diag(np.append(u.ravel(), np.full(3, np.inf)) ** 2))
    if options["prior"]:
        known, covariance = read_prior(options["prior"])
        return replace(priors, parameters=known, covariance=covariance)
    return priors


def read_prior(path: Path) -> tuple[Array, Array]:
    """S, Q (12,) and their covariance (12, 12), inf for what was not known, of an earlier result. Raises TableError."""
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
        values = np.array([x for row in before["sensitivity"] for x in row] + before["offset"], dtype=float)
        covariance = np.array(before["covariance"], dtype=float)
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise TableError(f"{path}: not a result of fieldcal calibrate: {error!r}") from None
    if values.shape != (12,) or covariance.shape != (12, 12):
        raise TableError(f"{path}: sensitivity must be 3 x 3, offset 3, covariance 12 x 12")
    unknown = ~np.isfinite(values) | ~np.isfinite(np.diag(covariance))
    covariance[unknown] = 0.0
    covariance[:, unknown] = 0.0
    covariance[unknown, unknown] = np.inf
    return np.where(unknown, 0.0, values), covariance
