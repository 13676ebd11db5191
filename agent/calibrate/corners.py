"""AC-coupled instruments of `fieldcal calibrate`: stated corners undone, the integral kept to find what is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from agent.calibrate.poses import PoseInterval
from agent.calibrate.tables import ReferenceTable, SensorTable, TableError
from calib.estimate.nuisances import Priors
from calib.model import Array
from calib.signal.corner import integral, with_integral, without_corner
from calib.signal.stamps import clock_from_stamps


def uncoupled(
    sensor: SensorTable, reference: ReferenceTable, poses: Sequence[PoseInterval], priors: Priors
) -> tuple[SensorTable, ReferenceTable, list[PoseInterval]]:
    """The tables before their filters, the reference with its integral as further channels, and the poses for that.

    Whole recordings in memory: a filter forgets over minutes. Raises TableError for a velocity reference, which has no
    such corner.
    """
    if reference.velocity:
        raise TableError(f"{reference.path}: a velocity reference has no corner frequency to undo")
    x, rate_hz = np.asarray(reference.x), clock_from_stamps(reference.time_s).rate_hz
    before = without_corner(x, rate_hz, priors.reference_corner_at_hz)
    channels = np.hstack([before, integral(x, rate_hz)])
    moved = [replace(p, pose=with_integral(p.pose)) for p in poses]
    return replace(sensor, v=_of_sensor(sensor, priors)), replace(reference, x=channels), moved


def has_corner(priors: Priors) -> bool:
    """Whether a corner is stated, or not known."""
    return any(
        (
            priors.reference_corner_at_hz,
            priors.reference_corner_hz,
            priors.sensor_corner_at_hz,
            priors.sensor_corner_hz,
        )
    )


def _of_sensor(sensor: SensorTable, priors: Priors) -> Array:
    if not priors.sensor_corner_at_hz:
        return sensor.v
    return without_corner(np.asarray(sensor.v), clock_from_stamps(sensor.time_s).rate_hz, priors.sensor_corner_at_hz)
