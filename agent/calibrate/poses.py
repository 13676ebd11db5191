"""Reads poses.csv. The pose of each line also depends on the kind of the reference and on the options."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from agent.calibrate.wrong_unit import unit_hint
from agent.reading.delimited import fields_of, number_of
from agent.reading.dialect import Dialect, dialect_of, lines_of
from agent.reading.source import TableError
from agent.reading.units import SUFFIXES
from calib.geometry import STANDARD_GRAVITY_MPS2, along, at_rest, beside, clamp, on_axis
from calib.model import Array, Pose

CLAMP, DIRECTION, AXIS, GRAVITY = ("theta_deg", "alpha_deg"), ("dx", "dy", "dz"), ("axis",), ("gx", "gy", "gz")
FORMS = (CLAMP, DIRECTION, AXIS, GRAVITY)
TOGETHER = ([DIRECTION, GRAVITY], [AXIS, GRAVITY])
LEAST_GRAVITY_MPS2, MOST_GRAVITY_MPS2 = 9.65, 9.95  # 9.76 to 9.84 on Earth; components may be rounded to 0.05
NOT_FELT = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class PoseRow:
    """One line of poses.csv: its number, start and stop in s, and the fields of its form."""

    line: int
    start_s: float
    stop_s: float
    values: dict[str, float]
    axis: str | None = None


@dataclass(frozen=True, slots=True)
class Setting:
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


def read_poses(path: Path, setting: Setting) -> list[PoseInterval]:
    """The lines of poses.csv as poses. Raises TableError."""
    intervals = []
    for row in read_rows(path):
        try:
            intervals.append(PoseInterval(row.start_s, row.stop_s, pose_of(row, setting)))
        except ValueError as error:
            raise TableError(f"{path}, line {row.line}: {error}") from None
    return intervals


def pose_of(row: PoseRow, setting: Setting) -> Pose:
    """One line as a pose. Raises ValueError if the line does not suit the setting."""
    stated = [row.values[name] for name in GRAVITY] if GRAVITY[0] in row.values else None
    gravity = _felt(stated, setting)
    if setting.reference_channels == 3:
        if CLAMP[0] in row.values or DIRECTION[0] in row.values or row.axis is not None:
            raise ValueError(
                "a tri-axial reference measures the direction itself: remove it here, and give --rotation, "
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
            "this pose states a direction of motion, so --reference is needed; for a rest give gx,gy,gz alone"
        )
    return _without_what_the_reference_feels(pose) if setting.reference_coupling == "dc" else pose


def beside_reference(setting: Setting, gravity: Sequence[float] | None = None) -> Pose:
    """The pose beside a tri-axial reference; `gravity` is from poses.csv, None if it is not stated there."""
    if setting.rotation is None:
        raise ValueError("a tri-axial reference needs --rotation, its orientation against the sensor")
    if setting.coupling == "dc" and setting.reference_coupling == "dc":
        return beside(setting.rotation, NOT_FELT)
    if setting.coupling == "ac" and setting.reference_coupling == "dc":
        return beside(setting.rotation)  # only the mean of the reference contains gravity
    return beside(setting.rotation, _felt(gravity, setting))


def _felt(stated: Sequence[float] | None, setting: Setting) -> Sequence[float] | None:
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


def _at_rest(gravity: Sequence[float] | None, setting: Setting) -> Pose:
    assert gravity is not None
    if setting.coupling == "ac":
        raise ValueError(
            "an AC-coupled sensor does not measure gravity, so a static position gives no information; remove it"
        )
    if setting.reference_channels:
        raise ValueError(
            "gx,gy,gz alone is a static position, which is for use without --reference; add the direction of motion"
        )
    return at_rest(gravity)


def _without_what_the_reference_feels(pose: Pose) -> Pose:
    """The pose without gravity along the axis of the reference, because a DC-coupled reference measures that itself."""
    d = pose.direction[:, 0]
    return replace(pose, gravity_mps2=pose.gravity_mps2 - d * float(d @ pose.gravity_mps2))


def read_rows(path: Path) -> list[PoseRow]:
    """The lines of poses.csv, in any of its forms. Raises TableError."""
    dialect = dialect_of(path)
    lines = [(number, dialect.fields(line)) for number, line in lines_of(path, dialect)]
    header = dialect.header
    _require(path, dialect, ("start_s", "stop_s"))
    forms = [form for form in FORMS if set(form) & set(header)]
    if len(forms) != 1 and forms not in TOGETHER:
        wanted = "; ".join(",".join(form) for form in FORMS)
        raise TableError(
            f"{path}, line {dialect.header_line}: expected one of {wanted} (gravity may go with a direction or an "
            f"axis); the header is {','.join(header)!r}"
        )
    names = [name for form in forms for name in form]
    _require(path, dialect, names)
    rows = [_row(path, line, dialect, fields_of(path, line, row, header), names) for line, row in lines]
    if not rows:
        raise TableError(f"{path}: the file has no poses; add a line for each pose")
    for before, row in itertools.pairwise(sorted(rows, key=lambda row: row.start_s)):
        if row.start_s < before.stop_s:
            both = f"this pose begins at {row.start_s:g} s, before {before.stop_s:g} s, the end of the pose in line"
            raise TableError(f"{path}, line {row.line}, column start_s: {both} {before.line}")
    return rows


def _row(path: Path, line: int, dialect: Dialect, fields: Sequence[str], names: Sequence[str]) -> PoseRow:
    places = {name: dialect.header.index(name) for name in ("start_s", "stop_s", *names)}
    axis = fields[places.pop("axis")] if "axis" in names else None
    values = {name: number_of(path, line, dialect, k, fields[k]) for name, k in places.items()}
    for name, value in values.items():
        if math.isnan(value):
            raise TableError(f"{path}, line {line}, column {name}: {fields[places[name]]!r} is not a finite number")
    start_s, stop_s = values.pop("start_s"), values.pop("stop_s")
    if not stop_s > start_s:
        raise TableError(f"{path}, line {line}, column stop_s: {stop_s:g} is not after start_s {start_s:g}")
    return PoseRow(line, start_s, stop_s, values, axis)


def _require(path: Path, dialect: Dialect, names: Sequence[str]) -> None:
    """Check that all columns are there once. Raises TableError."""
    where = f"{path}, line {dialect.header_line}"
    header = dialect.header
    if len(set(header)) < len(header):
        raise TableError(f"{where}: a column is there twice, remove one: {','.join(header)!r}")
    for name in names:
        if name not in header:
            stem = name.rsplit("_", 1)[0]
            others = [n for n in header if n.rsplit("_", 1)[0] == stem and n.rpartition("_")[2] in {*SUFFIXES, "rad"}]
            hint = f"; {others[0]} has another unit, convert it" if others else ""
            raise TableError(f"{where}: column {name} is missing in the header {','.join(header)!r}{hint}")
