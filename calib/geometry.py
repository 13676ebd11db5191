"""Poses: what the ideal sensor feels for every unit of the reference, Eqs. (5)-(7) and (9)-(11), and without a clamp.

Every function gives a `Pose`: `a(t) = direction @ u(t) + gravity_mps2` in the sensor's frame. They raise ValueError
with the value that is wrong; none of them guesses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from calib.model import Array, Pose

STANDARD_GRAVITY_MPS2 = 9.80665
# A direction written with three decimals is off a unit length by up to 1e-3; what is further off was not meant as one.
UNIT_TOLERANCE = 2e-3
AXES = ("x", "y", "z")
UNKNOWN_GRAVITY = (float("nan"),) * 3


def clamp(
    theta_rad: float,
    alpha_rad: float,
    gravity_mps2: float = STANDARD_GRAVITY_MPS2,
    static_sign: int = 1,
    position: str | None = None,
) -> Pose:
    """The sensor on the inclined clamp: inclination theta, rotation alpha on its surface (Eqs. 5-7 and 9-11).

    `a = a_ref d + g e` with d = (-sin a cos t, -cos a cos t, sin t), e = (-sin t sin a, -sin t cos a, -cos t).
    `gravity_mps2` 0 is the AC-coupled sensor (Eqs. 5-7). `static_sign` is +1 as printed (z points into the clamp), -1
    for z outward.
    """
    _finite("theta, alpha, gravity", [theta_rad, alpha_rad, gravity_mps2])
    if static_sign not in (1, -1):
        raise ValueError(f"static sign must be +1 or -1, is {static_sign}")
    sin_t, cos_t = np.sin(theta_rad), np.cos(theta_rad)
    sin_a, cos_a = np.sin(alpha_rad), np.cos(alpha_rad)
    direction = np.array([[-sin_a * cos_t], [-cos_a * cos_t], [sin_t]])
    static = np.array([-sin_t * sin_a, -sin_t * cos_a, -cos_t])
    name = f"theta {np.degrees(theta_rad):.6g} deg, alpha {np.degrees(alpha_rad):.6g} deg"
    return Pose(position or name, direction, static_sign * gravity_mps2 * static, float(theta_rad), float(alpha_rad))


def along(
    direction: Sequence[float] | Array, gravity_mps2: Sequence[float] | Array | None = None, position: str | None = None
) -> Pose:
    """A uniaxial reference along a unit vector of the sensor's frame (3,).

    `gravity_mps2` (3,) is what an ideal sensor reads at rest there; None where nobody stated it: the offset then stays
    unknown. Zeros for an AC-coupled sensor.
    """
    d = _vector("direction", direction)
    length = float(np.linalg.norm(d))
    if abs(length - 1.0) > UNIT_TOLERANCE:
        raise ValueError(f"direction must be a unit vector, {_text(d)} has length {length:.6g}")
    gravity = np.array(UNKNOWN_GRAVITY) if gravity_mps2 is None else _vector("gravity", gravity_mps2)
    return Pose(position or f"direction {_text(d)}", (d / length)[:, None], gravity)


def on_axis(
    axis: Literal["x", "y", "z"] | str, gravity_mps2: Sequence[float] | Array | None = None, position: str | None = None
) -> Pose:
    """One axis of the sensor along the motion (Method 1, Eqs. 2-4)."""
    if axis not in AXES:
        raise ValueError(f"axis must be x, y or z, is {axis!r}")
    return along(np.eye(3)[AXES.index(axis)], gravity_mps2, position or f"axis {axis}")


def at_rest(gravity_mps2: Sequence[float] | Array, position: str | None = None) -> Pose:
    """No reference: gravity alone, (3,), as an ideal sensor reads it at rest (+g on the axis that points up)."""
    gravity = _vector("gravity", gravity_mps2)
    return Pose(position or f"rest {_text(gravity)}", np.zeros((3, 0)), gravity)


def beside(
    rotation: Sequence[Sequence[float]] | Array,
    gravity_mps2: Sequence[float] | Array | None = None,
    position: str = "beside the reference",
) -> Pose:
    """A tri-axial reference beside the sensor: a = R a_ref (+ gravity), R (3, 3) a rotation.

    `gravity_mps2` zeros where the reference feels gravity itself; what the sensor reads at rest where the reference is
    AC-coupled; None where nobody stated it.
    """
    r = np.asarray(rotation, dtype=float)
    if r.shape != (3, 3):
        raise ValueError(f"rotation must be 3 x 3, is {' x '.join(map(str, r.shape))}")
    _finite("rotation", r.ravel())
    off = float(np.abs(r @ r.T - np.eye(3)).max())
    if off > UNIT_TOLERANCE or np.linalg.det(r) < 0:
        raise ValueError(
            f"rotation is not one: R R' differs from 1 by {off:.3g}, its determinant is {np.linalg.det(r):.6g}"
        )
    left, _, right = np.linalg.svd(r)  # the nearest rotation: rounding of the nine numbers must not scale S
    gravity = np.array(UNKNOWN_GRAVITY) if gravity_mps2 is None else _vector("gravity", gravity_mps2)
    return Pose(position, left @ right, gravity)


def _vector(name: str, values: Sequence[float] | Array) -> Array:
    v = np.asarray(values, dtype=float)
    if v.shape != (3,):
        raise ValueError(f"{name} must have 3 components, has {v.size}")
    _finite(name, v)
    return v


def _finite(name: str, values: Sequence[float] | Array) -> None:
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name} must be finite, is {_text(values)}")


def _text(values: Sequence[float] | Array) -> str:
    return "(" + ", ".join(f"{float(v):.6g}" for v in values) + ")"
