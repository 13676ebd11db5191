"""Transverse motion is one unknown where what moves the sensor stands alike, and another where it was set up anew."""

from __future__ import annotations

import numpy as np

from calib.estimate.nuisances import Priors
from calib.estimate.terms import terms
from calib.geometry import along, clamp
from calib.model import Pose

G_MPS2 = 9.81


def at_angle(angle_deg: float, turned_deg: float) -> Pose:
    """Motion at an angle to gravity, of a sensor that is turned about its z-axis, along which it moves."""
    angle, turned = np.deg2rad([angle_deg, turned_deg])
    across = np.array([np.cos(turned), np.sin(turned), 0.0])
    gravity = G_MPS2 * (np.cos(angle) * np.array([0.0, 0.0, 1.0]) + np.sin(angle) * across)
    return along([0.0, 0.0, 1.0], gravity, position=f"{angle_deg} {turned_deg}")


def unknowns(*poses: Pose) -> dict[str, list[int]]:
    """The positions that each unknown in phase moves, by its name."""
    found = [term for term in terms(poses, 1, Priors(), {}) if term.name.startswith("transverse")]
    in_phase = [term for term in found if not term.name.endswith("_quadrature")]
    return {term.name: np.flatnonzero(np.any(term.transverse, axis=1)).tolist() for term in in_phase}


def test_positions_at_one_angle_to_gravity_share_it() -> None:
    expected = {"transverse_lateral": [0, 1, 2], "transverse_vertical": [0, 1, 2]}
    assert unknowns(at_angle(90.0, 0.0), at_angle(90.0, 70.0), at_angle(90.2, 200.0)) == expected


def test_another_angle_has_its_own_by_whatever_positions_are_beside_it() -> None:
    assert unknowns(at_angle(35.0, 10.0)) == {"transverse_lateral at 35 deg": [0], "transverse_vertical at 35 deg": [0]}
    found = unknowns(at_angle(90.0, 0.0), at_angle(35.0, 10.0), at_angle(90.0, 50.0), at_angle(35.0, 80.0))
    assert found == {
        "transverse_lateral": [0, 2],
        "transverse_vertical": [0, 2],
        "transverse_lateral at 35 deg": [1, 3],
        "transverse_vertical at 35 deg": [1, 3],
    }


def test_a_slide_is_one_thing_at_any_inclination() -> None:
    poses = [clamp(np.deg2rad(theta), np.deg2rad(alpha)) for theta, alpha in ((35.0, 0.0), (50.0, 90.0))]
    assert unknowns(*poses) == {"transverse_lateral": [0, 1], "transverse_vertical": [0, 1]}
