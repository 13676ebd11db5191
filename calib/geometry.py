"""Poses: the input acceleration of a sensor on the clamp (Eqs. 5-7 and 9-11), along any direction, or at rest.

Every function returns a `Pose`: `a(t) = direction @ u(t) + gravity_mps2` in the sensor's frame. Every function raises
ValueError, with the wrong value in the message, if an argument has the wrong shape, is not finite or is out of range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal
from typing import Literal

import numpy as np

from calib.model import Array, Pose

STANDARD_GRAVITY_MPS2 = 9.80665
NOMINAL_DECIMALS = 2  # a value of gravity with no more is that of a table or of a habit, not of a place
# Of a nominal value: 9.81 is right within it from 39 to 60 degrees of latitude (normal gravity of WGS 84).
U_NOMINAL_GRAVITY_MPS2 = 0.01
# A unit vector written with three decimals has a length that is off by up to 1e-3. A larger error is a mistake.
UNIT_TOLERANCE = 2e-3
AXES = ("x", "y", "z")
UNKNOWN_GRAVITY = (float("nan"),) * 3


def u_of_gravity_mps2(gravity_mps2: float) -> tuple[float, str]:
    """Standard uncertainty of a stated gravity by its digits, m/s2, and the reason for it in words.

    A value with at most two decimals, and standard gravity, are nominal. Of another one only the last digit is rounded.
    """
    exponent = Decimal(repr(float(gravity_mps2))).as_tuple().exponent
    assert isinstance(exponent, int)  # a finite number
    if gravity_mps2 == STANDARD_GRAVITY_MPS2:
        return U_NOMINAL_GRAVITY_MPS2, "it is standard gravity, not that of a place"
    if -exponent <= NOMINAL_DECIMALS:
        return U_NOMINAL_GRAVITY_MPS2, f"it has at most {NOMINAL_DECIMALS} decimals, as a nominal value has"
    return 0.5 * 10.0**exponent / math.sqrt(3.0), "half of its last digit"


def clamp(
    theta_rad: float,
    alpha_rad: float,
    gravity_mps2: float = STANDARD_GRAVITY_MPS2,
    static_sign: int = 1,
    position: str | None = None,
) -> Pose:
    """The sensor on the inclined clamp: inclination theta, rotation alpha on its surface (Eqs. 5-7 and 9-11).

    `a = a_ref d + g e` with d = (-sin a cos t, -cos a cos t, sin t), e = (-sin t sin a, -sin t cos a, -cos t), where t
    is theta and a is alpha. `gravity_mps2` is g in m/s2; 0 for an AC-coupled sensor (Eqs. 5-7). `static_sign` is +1 as
    in the paper (z points into the clamp), -1 if z points out of the clamp. `position` names the pose; by default the
    angles do. Raises ValueError if a value is not finite or the sign is not +1 or -1.
    """
    _finite("theta, alpha, gravity", [theta_rad, alpha_rad, gravity_mps2])
    if static_sign not in (1, -1):
        raise ValueError(f"static sign must be +1 or -1, is {static_sign}: +1 means z points into the clamp")
    sin_t, cos_t = np.sin(theta_rad), np.cos(theta_rad)
    sin_a, cos_a = np.sin(alpha_rad), np.cos(alpha_rad)
    direction = np.array([[-sin_a * cos_t], [-cos_a * cos_t], [sin_t]])
    static = np.array([-sin_t * sin_a, -sin_t * cos_a, -cos_t])
    name = f"theta {np.degrees(theta_rad):.6g} deg, alpha {np.degrees(alpha_rad):.6g} deg"
    return Pose(position or name, direction, static_sign * gravity_mps2 * static, float(theta_rad), float(alpha_rad))


def along(
    direction: Sequence[float] | Array, gravity_mps2: Sequence[float] | Array | None = None, position: str | None = None
) -> Pose:
    """The pose of a sensor whose uniaxial reference moves along `direction` (3,), a unit vector of the sensor's frame.

    `gravity_mps2` (3,) is what an ideal sensor reads at rest in this pose; zeros for an AC-coupled sensor; None if it
    is not known: the offset is then not determined. Raises ValueError if `direction` has not the length 1.
    """
    d = _vector("direction", direction)
    length = float(np.linalg.norm(d))
    if abs(length - 1.0) > UNIT_TOLERANCE:
        raise ValueError(
            f"direction must be a unit vector, {_text(d)} has length {length:.6g}: divide it by its length"
        )
    gravity = np.array(UNKNOWN_GRAVITY) if gravity_mps2 is None else _vector("gravity", gravity_mps2)
    return Pose(position or f"direction {_text(d)}", (d / length)[:, None], gravity)


def on_axis(
    axis: Literal["x", "y", "z"] | str, gravity_mps2: Sequence[float] | Array | None = None, position: str | None = None
) -> Pose:
    """The pose of a sensor with one of its axes along the motion (Method 1, Eqs. 2-4); see `along`."""
    if axis not in AXES:
        raise ValueError(f"axis must be x, y or z, is {axis!r}")
    return along(np.eye(3)[AXES.index(axis)], gravity_mps2, position or f"axis {axis}")


def at_rest(gravity_mps2: Sequence[float] | Array, position: str | None = None) -> Pose:
    """The pose of a sensor at rest, without a reference: gravity is the excitation.

    `gravity_mps2` (3,) is what an ideal sensor reads in this pose: +g on an axis that points up.
    """
    gravity = _vector("gravity", gravity_mps2)
    return Pose(position or f"rest {_text(gravity)}", np.zeros((3, 0)), gravity)


def beside(
    rotation: Sequence[Sequence[float]] | Array,
    gravity_mps2: Sequence[float] | Array | None = None,
    position: str = "beside the reference",
) -> Pose:
    """The pose of a sensor beside a tri-axial reference: a = R a_ref + gravity, with the rotation matrix R (3, 3).

    `gravity_mps2` (3,): zeros if the reference is DC-coupled (it measures gravity itself). If the reference is
    AC-coupled, what an ideal sensor reads at rest in this pose, or None if that is not known. Raises ValueError if R is
    not a rotation.
    """
    r = np.asarray(rotation, dtype=float)
    if r.shape != (3, 3):
        raise ValueError(f"rotation must be 3 x 3, is {' x '.join(map(str, r.shape))}")
    _finite("rotation", r.ravel())
    off = float(np.abs(r @ r.T - np.eye(3)).max())
    if off > UNIT_TOLERANCE or np.linalg.det(r) < 0:
        raise ValueError(
            f"rotation must be a rotation matrix: R R' differs from the identity by {off:.3g} (limit "
            f"{UNIT_TOLERANCE:g}), and the determinant is {np.linalg.det(r):.6g} (must be +1)"
        )
    left, _, right = np.linalg.svd(r)  # left @ right is the nearest rotation: rounded numbers must not scale S
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
