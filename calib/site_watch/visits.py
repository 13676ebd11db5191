"""What a visit says of the watch: whether a suspicion was right, how far the scatter is what the watch believes, and
how far all sensors have changed alike.

A visit finds the change of a sensor by itself. The watch has said how far this sensor changed against all others. What
differs is what all others share.
"""

from __future__ import annotations

import numpy as np

from calib.model import Array
from calib.site_watch.day import Visits
from calib.site_watch.together import DIRECTIONS
from calib.site_watch.verdicts import COVERAGE, SensorVerdict, result
from calib.site_watch.watch import VISIT, SiteWatch


def teach(watch: SiteWatch, visits: Visits, known_u: Array | None = None) -> None:
    """Compare what the watch says of the visited sensors with what was found. Call it before the day of the visits is
    taken.

    A sensor that learns, and a visit whose finding is not known, teach nothing.
    """
    known = np.flatnonzero(visits.there & np.isfinite(visits.found).any(axis=1) & np.isfinite(visits.u))
    if not len(known) or watch.day < 0:
        return
    told = result(watch, known_u)
    rows = []
    for i in known.tolist():
        with_gateway = told.gateways.get(int(watch.gateway[i]))
        verdict = told.sensors[i] if with_gateway is None else with_gateway
        rows.append(_row(i, watch.day + 1, verdict, told.least_detectable[i], visits))
    made = [row for row in rows if row is not None]
    if made:
        watch.visits = np.concatenate([watch.visits, np.array(made)])


def _row(i: int, day: int, told: SensorVerdict, least: Array, visits: Visits) -> list[float] | None:
    """A row of VISIT; None where the watch said nothing of this sensor. `told`: of the sensor, or of its gateway."""
    found, u_found = visits.found[i], float(visits.u[i])
    suspected = told.kind in ("sensitivity", "gateway")
    if suspected:
        axes = np.flatnonzero(DIRECTIONS[told.direction][:3]) if told.kind == "sensitivity" else np.arange(3)
        size, u = told.size, told.U / COVERAGE
    elif told.kind == "none" and np.isfinite(least).any():
        axes, size, u = np.arange(3), 0.0, float(np.min(least)) / COVERAGE
    else:
        return None
    own = found[axes][np.isfinite(found[axes])]
    if not len(own):
        return None
    mean = float(np.mean(np.log1p(np.maximum(own, -0.99))))
    row = {
        "sensor": i, "day": day, "suspected": suspected, "size": size, "u": u, "found": mean,
        "u_found": u_found,
    }  # fmt: skip
    return [float(row[name]) for name in VISIT]
