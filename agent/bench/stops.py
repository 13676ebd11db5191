"""The positions that a bench can take, how a person is told of them, and how a person names them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.geometry import at_rest, beside, clamp
from calib.model import Array, Pose

AXES = "xyz"
GRAVITY = ("gx", "gy", "gz")  # columns of poses.csv
FACE, CORNER = 1, 3  # how many axes point up equally, at most


@dataclass(frozen=True, slots=True, eq=False)
class BenchStop:
    """One position: `told` to people, `name` as a person types it, its pose, and its columns in poses.csv.

    `reference_mps2` (m,): the mean that the reference shows there.
    """

    told: str
    name: str
    pose: Pose
    columns: dict[str, float]
    reference_mps2: Array


def on_clamp(
    thetas_deg: Sequence[float], alphas_deg: Sequence[float], gravity_mps2: float, static_sign: int
) -> list[BenchStop]:
    """The positions of a clamp with these inclinations and rotations. `gravity_mps2` is 0 for an AC-coupled sensor."""
    return [
        BenchStop(
            f"incline the clamp to theta = {theta:g} deg and turn the sensor on it to alpha = {alpha:g} deg",
            f"{theta:g} {alpha:g}",
            clamp(float(np.deg2rad(theta)), float(np.deg2rad(alpha)), gravity_mps2, static_sign),
            {"theta_deg": float(theta), "alpha_deg": float(alpha)},
            np.zeros(1),
        )
        for theta, alpha in itertools.product(thetas_deg, alphas_deg)
    ]


def angles_of(text: str) -> tuple[float, float] | None:
    """theta and alpha in deg as a person types them; None for other texts."""
    try:
        theta_deg, alpha_deg = (float(part) for part in text.split())
    except ValueError:
        return None
    return (theta_deg, alpha_deg) if abs(theta_deg) <= 90.0 and abs(alpha_deg) <= 360.0 else None


def like(stop: BenchStop, theta_deg: float, alpha_deg: float) -> BenchStop:
    """Another position of the clamp on which `stop` is one."""
    gravity_mps2 = float(np.linalg.norm(stop.pose.gravity_mps2))
    upright = clamp(stop.pose.theta_rad or 0.0, stop.pose.alpha_rad or 0.0, 1.0).gravity_mps2
    sign = -1 if float(upright @ stop.pose.gravity_mps2) < 0.0 else 1
    return on_clamp([theta_deg], [alpha_deg % 360.0], gravity_mps2, sign)[0]


def turned_by_hand(rotation: Array, gravity_mps2: float) -> list[BenchStop]:
    """Rests of a sensor that is fixed to a calibrated triad: axes, edges and corners up. The triad tells how it stands.

    `rotation` (3, 3) is R in a = R a_ref.
    """
    pose = beside(rotation)
    return [
        BenchStop(
            f"turn sensor and reference together, until {told} up, and put them down",
            name,
            Pose(pose.position, pose.direction, np.zeros(3)),
            dict(zip(GRAVITY, (gravity_mps2 * up).tolist(), strict=True)),
            np.asarray(rotation).T @ (gravity_mps2 * up),
        )
        for told, name, up in ways(CORNER)
    ]


def on_faces(gravity_mps2: float) -> list[BenchStop]:
    """Rests on the six faces of the sensor's housing, on a level table."""
    found = []
    for told, name, up in ways(FACE):
        felt = gravity_mps2 * up
        columns = dict(zip(GRAVITY, felt.tolist(), strict=True))
        found.append(
            BenchStop(f"put the sensor on a level table, {told} up", name, at_rest(felt, name), columns, np.zeros(0))
        )
    return found


def ways(most: int) -> list[tuple[str, str, Array]]:
    """Directions with up to `most` axes up equally: for people, as typed, and the unit vector."""
    found = []
    for signs in itertools.product((0, 1, -1), repeat=3):
        if not 0 < np.count_nonzero(signs) <= most:
            continue
        parts = [f"{'-' if sign < 0 else '+'}{axis}" for sign, axis in zip(signs, AXES, strict=True) if sign]
        told = f"its {parts[0]} axis points" if len(parts) == 1 else f"its axes {', '.join(parts)} point equally far"
        found.append((len(parts), told, "".join(parts), np.array(signs) / np.sqrt(len(parts))))
    return [(told, name, up) for _, told, name, up in sorted(found, key=lambda each: each[0])]
