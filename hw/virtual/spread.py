"""Faults drawn from their priors: standard uncertainties of the method and the configuration become one true bench."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hw.virtual.parameters import BenchParameters, ClampErrors
from hw.virtual.schedule import rotation as about


@dataclass(frozen=True, slots=True)
class Spread:
    """Standard deviations of quantities that are not known exactly; 0: exact.

    Names as in `fieldcal calibrate --u-...`.
    """

    angle_deg: float = 0.0  # alpha, one error per position
    theta_deg: float = 0.0  # theta, one error common to all positions
    alpha_common_deg: float = 0.0
    theta_position_deg: float = 0.0
    offset_mps2: float = 0.0  # one offset per window, each axis
    offset_position_mps2: float = 0.0  # one offset per position, each axis
    reference_pct: float = 0.0
    transverse_motion_pct: float = 0.0  # lateral and vertical motion each, relative to the motion along the slide
    gravity_mps2: float = 0.0
    rotation_deg: float = 0.0  # mounting of a tri-axial reference, each axis


def drawn(parameters: BenchParameters, spread: Spread, random: np.random.Generator) -> BenchParameters:
    """`parameters` plus one draw of every fault in `spread`.

    The offset by window is drawn by the bench itself, because the number of windows is not limited; here only its
    standard deviation is set.
    """
    n = len(parameters.schedule.stands)
    sensor, reference, clamp = parameters.sensor, parameters.reference, parameters.clamp
    by_position = np.zeros((n, 3)) if sensor.offset_by_position_mps2 is None else sensor.offset_by_position_mps2
    lateral, vertical = spread.transverse_motion_pct / 100 * random.normal(size=2)
    theta, alpha = clamp.theta_by_position_deg or (0.0,) * n, clamp.alpha_by_position_deg or (0.0,) * n
    rotation = reference.rotation
    if rotation is not None:
        tilts = np.deg2rad(spread.rotation_deg) * random.normal(size=3)
        for axis, tilt in zip(np.eye(3), tilts, strict=True):
            rotation = about(axis, tilt) @ rotation
    return replace(
        parameters,
        motion=parameters.motion.with_transverse(lateral, vertical),
        gravity_mps2=parameters.gravity_mps2 + spread.gravity_mps2 * random.normal(),
        clamp=ClampErrors(
            theta_deg=clamp.theta_deg + spread.theta_deg * random.normal(),
            alpha_deg=clamp.alpha_deg + spread.alpha_common_deg * random.normal(),
            theta_by_position_deg=tuple(theta + spread.theta_position_deg * random.normal(size=n)),
            alpha_by_position_deg=tuple(alpha + spread.angle_deg * random.normal(size=n)),
        ),
        sensor=replace(
            sensor,
            offset_by_position_mps2=by_position + spread.offset_position_mps2 * random.normal(size=(n, 3)),
            offset_by_window_mps2=float(np.hypot(sensor.offset_by_window_mps2, spread.offset_mps2)),
        ),
        reference=replace(
            reference,
            rotation=rotation,
            sensitivity=reference.sensitivity * (1 + spread.reference_pct / 100 * random.normal()),
        ),
    )
