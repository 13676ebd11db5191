"""Poses as they are stated, row by row. The pose of a row also depends on the kind of the reference and the options."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calib.geometry import STANDARD_GRAVITY_MPS2, along, at_rest, beside, clamp, on_axis
from calib.model import Array, Pose
from calib.recorded.errors import InputError
from calib.recorded.wrong_unit import unit_hint

SPAN = ("start_s", "stop_s")
CLAMP, DIRECTION, AXIS, GRAVITY = ("theta_deg", "alpha_deg"), ("dx", "dy", "dz"), ("axis",), ("gx", "gy", "gz")
FORMS = (CLAMP, DIRECTION, AXIS, GRAVITY)
TOGETHER = ([DIRECTION, GRAVITY], [AXIS, GRAVITY])
LEAST_GRAVITY_MPS2, MOST_GRAVITY_MPS2 = 9.65, 9.95  # 9.76 to 9.84 on Earth; components may be rounded to 0.05
NOT_FELT = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class PoseRow:
    """One stated pose: start and stop in s, and the fields of its form."""

    start_s: float
    stop_s: float
    values: Mapping[str, float]
    axis: str | None = None


@dataclass(frozen=True, slots=True)
class PoseSettings:
    """Settings for every pose: gravity, the static sign of Eqs. (9)-(11), the couplings, and the rotation.

    `rotation` (3, 3) is for a tri-axial reference beside the sensor: a = R a_ref.
    """

    gravity_mps2: float = STANDARD_GRAVITY_MPS2
    static_sign: int = 1
    coupling: Literal["dc", "ac"] = "dc"  # of the sensor
    reference_coupling: Literal["dc", "ac"] = "ac"
    reference_channels: int = 1  # 0: there is no reference
    rotation: Array | None = None


@dataclass(frozen=True, slots=True)
class PoseInterval:
    """The sensor is in `pose` from `start_s` to `stop_s`."""

    start_s: float
    stop_s: float
    pose: Pose


def columns_of(header: Sequence[str], place: str) -> list[str]:
    """The columns of the forms that a header has. Raises InputError if they are none, too many, or not complete."""
    forms = [form for form in FORMS if set(form) & set(header)]
    if len(forms) != 1 and forms not in TOGETHER:
        wanted = "; ".join(",".join(form) for form in FORMS)
        raise InputError(
            f"expected one of {wanted} (gravity may go with a direction or an axis); the header is "
            f"{','.join(header)!r}", place=place, value=tuple(header),
        )  # fmt: skip
    return [name for form in forms for name in form]


@dataclass(frozen=True, slots=True)
class Poses:
    """Stated poses; `place`: the name of their file, or "poses".

    Raises InputError if there are none, if one stops before it starts, or if two overlap.
    """

    place: str
    rows: Sequence[PoseRow]

    def __post_init__(self) -> None:
        if not self.rows:
            raise InputError("there are no poses", "add a row for each pose", place=self.place)
        for k, row in enumerate(self.rows):
            if not row.stop_s > row.start_s:
                raise self._fault(k, "stop_s", row.stop_s, f"{row.stop_s:g} is not after start_s {row.start_s:g}")
        in_order = sorted(range(len(self.rows)), key=lambda k: self.rows[k].start_s)
        for before, k in itertools.pairwise(in_order):
            start_s, earlier = self.rows[k].start_s, self.rows[before]
            if start_s < earlier.stop_s:
                span = f"from {earlier.start_s:g} s to {earlier.stop_s:g} s"
                told = f"this pose begins at {start_s:g} s, before the end of the pose {span}"
                raise self._fault(k, "start_s", start_s, told)

    def _fault(self, row: int, column: str, value: float, problem: str) -> InputError:
        return InputError(problem, "correct the times", place=self.place, row=row, column=column, value=value)


def states_gravity(poses: Poses) -> bool:
    """Whether the poses say how gravity lies in the sensor's frame: so it tells S, whatever the reference says."""
    return any(name in row.values for row in poses.rows for name in (CLAMP[0], GRAVITY[0]))


def intervals_of(poses: Poses, setting: PoseSettings) -> list[PoseInterval]:
    """The poses in this setting. Raises InputError."""
    intervals = []
    for k, row in enumerate(poses.rows):
        try:
            intervals.append(PoseInterval(row.start_s, row.stop_s, pose_of(row, setting)))
        except ValueError as error:
            raise InputError(str(error), place=poses.place, row=k) from None
    return intervals


def pose_of(row: PoseRow, setting: PoseSettings) -> Pose:
    """One row as a pose. Raises ValueError if the row does not suit the setting."""
    stated = [row.values[name] for name in GRAVITY] if GRAVITY[0] in row.values else None
    gravity = _felt(stated, setting)
    if setting.reference_channels == 3:
        if CLAMP[0] in row.values or DIRECTION[0] in row.values or row.axis is not None:
            raise ValueError(
                "a tri-axial reference measures the direction itself: remove it here, and give `rotation`, "
                "and gx,gy,gz if the reference is AC-coupled"
            )
        return beside_reference(setting, stated)
    if CLAMP[0] in row.values:
        felt = setting.gravity_mps2 if setting.coupling == "dc" else 0.0
        theta, alpha = (float(np.deg2rad(row.values[name])) for name in CLAMP)
        pose = clamp(theta, alpha, felt, setting.static_sign)
    elif DIRECTION[0] in row.values:
        pose = along([row.values[name] for name in DIRECTION], gravity)
    elif row.axis is not None:
        pose = on_axis(row.axis.lower(), gravity)
    else:
        return _at_rest(stated, setting)
    if setting.reference_channels == 0:
        raise ValueError(
            "this pose states a direction of motion, so `reference` is needed; for a rest give gx,gy,gz alone"
        )
    return _without_what_the_reference_feels(pose) if setting.reference_coupling == "dc" else pose


def beside_reference(setting: PoseSettings, gravity: Sequence[float] | None = None) -> Pose:
    """The pose beside a tri-axial reference; `gravity` as its row states it, None if it is not stated there."""
    if setting.rotation is None:
        raise ValueError(
            "a tri-axial reference needs `rotation`, its orientation against the sensor; where the axes are parallel: "
            "1,0,0,0,1,0,0,0,1 as an option, a unit matrix in a notebook"
        )
    if setting.coupling == "dc" and setting.reference_coupling == "dc":
        return beside(setting.rotation, NOT_FELT)
    if setting.coupling == "ac" and setting.reference_coupling == "dc":
        return beside(setting.rotation)  # only the mean of the reference contains gravity
    return beside(setting.rotation, _felt(gravity, setting))


def _felt(stated: Sequence[float] | None, setting: PoseSettings) -> Sequence[float] | None:
    """Gravity that the sensor measures. Raises ValueError if its length is wrong, for example in g or in cm/s2."""
    if setting.coupling == "ac":
        return NOT_FELT
    if stated is not None and not LEAST_GRAVITY_MPS2 < math.hypot(*stated) < MOST_GRAVITY_MPS2:
        told = ", ".join(f"{g:.6g}" for g in stated)
        raise ValueError(
            f"gx,gy,gz ({told}) has length {math.hypot(*stated):.6g} m/s2, but gravity has 9.7 to 9.9 m/s2"
            f"{unit_hint(math.hypot(*stated))}"
        )
    return stated


def _at_rest(gravity: Sequence[float] | None, setting: PoseSettings) -> Pose:
    assert gravity is not None
    if setting.coupling == "ac":
        raise ValueError(
            "an AC-coupled sensor does not measure gravity, so a static position gives no information; remove it"
        )
    if setting.reference_channels:
        raise ValueError(
            "gx,gy,gz alone is a static position, which is for use without `reference`; add the direction of motion"
        )
    return at_rest(gravity)


def _without_what_the_reference_feels(pose: Pose) -> Pose:
    """The pose without gravity along the axis of the reference, because a DC-coupled reference measures that itself."""
    d = pose.direction[:, 0]
    return replace(pose, gravity_mps2=pose.gravity_mps2 - d * float(d @ pose.gravity_mps2))
