"""The table of unknowns: what each quantity of a joint state is, and all that the estimators need to know of it.

A new unknown is one `Kind` in this file and, in calib.estimate.terms, the geometry of what it moves. No other file
decides anything by the name of an unknown: a name is for people and for looking up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np

from calib.model import PARAMETERS

# Change up to which the products of S with an unknown count as straight, so that nothing is linearised anew: relative
# of S, or rad of an angle. The product with an angle's 0.3 deg is 5e-6 of S.
STRAIGHT = 1e-3
STRAIGHT_LAG_S = 5e-5  # (omega lag)^2 / 2 of it at 10 Hz is as much
LINEAR = np.inf  # S does not multiply it


def _deg(value: float) -> float:
    return float(np.deg2rad(value))


def _minus(value: float) -> float:
    return -value


def _percent(value: float) -> float:
    return value / 100.0


@dataclass(frozen=True, slots=True)
class Statement:
    """A number that is stated before any data: a standard uncertainty, a mean or the step of a random walk.

    `name` in `calib.estimate.nuisances.Priors` or `calib.estimate.wander.Wander`, with its unit. `default` where nobody
    states it. `configuration`: its places in a channel of the configuration as "section.field"; several are combined as
    the root of their sum of squares. `at_fixed_mount`: the places that count instead where the sensor never turns.
    `option`: its name among the options of `fieldcal calibrate`. `convert` turns the unit of both into that of `name`.
    """

    name: str
    default: float = 0.0
    configuration: tuple[str, ...] = ()
    at_fixed_mount: tuple[str, ...] = ()
    option: str = ""
    convert: Callable[[float], float] = float


Loosening = Literal["", "jump", "lean", "line"]


@dataclass(frozen=True, slots=True)
class Kind:
    """What unknowns of one kind have in common.

    `name`: under it a snapshot stores the kind; another name needs a migration (agent.core.migrations).
    `unit`: of the value; "" for S and Q and what belongs to them, which are in the sensor's output unit.
    `source`: the line of an uncertainty budget that its prior belongs to.
    `prior`, `mean`: its standard uncertainty and its value before any data; without `mean` the value is 0. Where
    `prior` is None, calib.estimate.recursion gets the uncertainty as an argument (S, Q, coefficients of temperature).
    `walk`: its random walk, standard deviation after one day; None for a constant.
    `in_output_unit`: `walk` and `straight` are relative to the sensor's output unit per m/s2.
    `loosened_by`: what may have changed it at once: a "jump" of the sensor that further windows confirmed, a "lean" of
    a mount that does not turn, a new "line" (a device or its wiring that began anew).
    `of_reference`: it belongs to the reference, and is dropped when another reference stands there.
    `straight`: change up to which its product with S counts as straight; LINEAR where S does not multiply it.
    `stated`: the prior is a statement that the data may contradict; of the others the data alone tell.
    """

    name: str
    unit: str = ""
    source: str = ""
    prior: Statement | None = None
    mean: Statement | None = None
    walk: Statement | None = None
    in_output_unit: bool = False
    loosened_by: Loosening = ""
    of_reference: bool = False
    straight: float = STRAIGHT
    stated: bool = True

    @property
    def statements(self) -> list[Statement]:
        """What is stated of its value before any data."""
        return [s for s in (self.prior, self.mean) if s is not None]


@dataclass(frozen=True, slots=True)
class Quantity:
    """One unknown: its name, its kind, and the position that it belongs to ("" where it belongs to all)."""

    name: str
    kind: Kind
    position: str = ""


@dataclass(frozen=True, init=False)
class Stated:
    """Values of a table of statements, as attributes by their names."""

    table: ClassVar[Mapping[str, Statement]] = {}
    values: Mapping[str, float]

    def __init__(self, values: Mapping[str, float] | None = None, **stated: float) -> None:
        """`stated` counts before `values`, and these before the defaults. Raises TypeError for an unknown name."""
        told = {**(values or {}), **stated}
        unknown = [name for name in told if name not in self.table]
        if unknown:
            raise TypeError(f"{type(self).__name__} has no {', '.join(unknown)}; it has {', '.join(self.table)}")
        object.__setattr__(self, "values", {name: told.get(name, s.default) for name, s in self.table.items()})

    @classmethod
    def none(cls) -> Self:
        """All of them 0."""
        return cls(dict.fromkeys(cls.table, 0.0))

    def __getattr__(self, name: str) -> float:
        values: Mapping[str, float] = self.__dict__.get("values", {})
        if name not in values:
            raise AttributeError(f"{type(self).__name__} has no {name}")
        return values[name]

    def of(self, statement: Statement | None) -> float:
        """The value of a statement; 0 where there is none."""
        return 0.0 if statement is None else self.values[statement.name]


def by_name(statements: Iterable[Statement]) -> dict[str, Statement]:
    """A table of statements."""
    return {s.name: s for s in statements}


# --- the sensor

SENSITIVITY = Kind(
    "sensitivity",
    walk=Statement("sensitivity", 5e-5, ("process.sensitivity_pct",), convert=_percent),
    in_output_unit=True,
    loosened_by="jump",
)
TILT_WALK = Statement("tilt_rad", 3.5e-5, ("process.tilt_deg",), convert=_deg)
OFFSET = Kind(
    "offset",
    walk=Statement("offset_mps2", 0.002, ("process.offset_mps2",)),
    in_output_unit=True,
    loosened_by="jump",
    straight=LINEAR,
)
OFFSET_RATE = Kind(
    "offset rate",
    prior=Statement("offset_rate_mps2", 0.001, ("process.offset_rate_mps2",)),
    walk=Statement("offset_rate_walk_mps2", 2e-5, ("process.offset_rate_walk_mps2",)),
    in_output_unit=True,
    straight=LINEAR,
)
SENSITIVITY_TEMPERATURE = Kind("sensitivity over temperature")
OFFSET_TEMPERATURE = Kind("offset over temperature", straight=LINEAR)
SENSOR_CORNER = Kind(
    "sensor corner", "Hz", "corner frequency",
    prior=Statement("sensor_corner_hz", 0.0, ("prior.u_corner_hz",), option="u_sensor_corner_hz"),
    mean=Statement("sensor_corner_at_hz", 0.0, ("prior.corner_hz",), option="sensor_corner_hz"),
)  # fmt: skip
LAG = Kind(
    "lag", "s", "lag",
    # A sensor's own low-pass filter and what a clock fit leaves: 0.5 to 15 ms are seen. The sensor's own lag and the
    # reference's are one unknown: by how much the sensor's indications come after the reference's.
    prior=Statement("lag_s", 0.02, ("uncertainty.lag_s", "certificate.u_lag_s")),
    mean=Statement("lag_at_s", 0.0, ("certificate.lag_s",), convert=_minus),
    loosened_by="line", of_reference=True, straight=STRAIGHT_LAG_S, stated=False,
)  # fmt: skip
LAG_OF_AXIS = Kind(
    "lag of axis", "s", "lag",
    # Axes share filter and clock; multiplexed converters differ by 0.1 ms.
    prior=Statement("lag_axis_s", 2e-4),
    of_reference=True, straight=STRAIGHT_LAG_S, stated=False,
)  # fmt: skip

# --- how it stands

THETA = Kind(
    "theta", "rad", "theta common",
    prior=Statement("theta_rad", _deg(0.2), ("uncertainty.theta_deg",), option="u_theta_deg", convert=_deg),
)  # fmt: skip
THETA_BY_POSITION = Kind(
    "theta by position", "rad", "theta by position",
    prior=Statement(
        "theta_position_rad", 0.0, ("uncertainty.theta_position_deg",), option="u_theta_position_deg", convert=_deg
    ),
)  # fmt: skip
ALPHA_COMMON = Statement(
    "alpha_common_rad", _deg(0.1), ("uncertainty.alpha_common_deg",), option="u_alpha_common_deg", convert=_deg
)
ANGLE = Statement("angle_rad", _deg(0.2), ("uncertainty.angle_deg",), option="u_angle_deg", convert=_deg)
ALPHA = Kind("alpha", "rad", "alpha common", prior=ALPHA_COMMON)
ALPHA_BY_POSITION = Kind("alpha by position", "rad", "alpha by position", prior=ANGLE)
DIRECTION = Kind("direction", "rad", "direction common", prior=ALPHA_COMMON)
DIRECTION_BY_POSITION = Kind("direction by position", "rad", "direction by position", prior=ANGLE)
GRAVITY_DIRECTION = Kind(
    # Beside a tri-axial reference, whose mounting turns by itself.
    "gravity direction by position", "rad", "direction by position",
    prior=Statement(
        "gravity_direction_rad", _deg(0.2), ("uncertainty.angle_deg",), ("uncertainty.tilt_deg",),
        option="u_angle_deg", convert=_deg,
    ),
    walk=TILT_WALK, loosened_by="lean",
)  # fmt: skip
LEAN = Kind(
    # Of a mount that does not turn, with the sensor and its reference on it: gravity turns, the direction does not.
    "lean", "rad", "tilt",
    prior=Statement("lean_rad", at_fixed_mount=("uncertainty.tilt_deg",), convert=_deg),
    walk=TILT_WALK, loosened_by="lean",
)  # fmt: skip
TILT = Kind(
    "tilt", "rad", "tilt",
    prior=Statement("tilt_rad", option="u_tilt_deg", convert=_deg),
    walk=TILT_WALK,
)  # fmt: skip
OFFSET_BY_POSITION = Kind(
    "offset by position", "m/s2", "offset by position",
    prior=Statement(
        "offset_position_mps2", 0.0, ("uncertainty.offset_position_mps2",), option="u_offset_position_mps2"
    ),
    straight=LINEAR,
)  # fmt: skip
GRAVITY = Kind(
    "gravity", "m/s2", "gravity",
    prior=Statement("gravity_mps2", 0.03, ("uncertainty.gravity_mps2",), option="u_gravity_mps2"),
    straight=10.0 * STRAIGHT,
)  # fmt: skip

# --- the reference

REFERENCE = Kind(
    "reference sensitivity", "1", "reference sensitivity",
    prior=Statement("reference", 1e-3, ("certificate.u_sensitivity_pct",), option="u_reference_pct", convert=_percent),
    walk=Statement("reference", 0.0, ("process.reference_pct",), convert=_percent),
    of_reference=True,
)  # fmt: skip
REFERENCE_CORNER = Kind(
    "reference corner", "Hz", "corner frequency",
    prior=Statement("reference_corner_hz", 0.0, ("certificate.u_corner_hz",), option="u_reference_corner_hz"),
    mean=Statement("reference_corner_at_hz", 0.0, ("certificate.corner_hz",), option="reference_corner_hz"),
    of_reference=True,
)  # fmt: skip
ROTATION = Kind(
    "mounting rotation", "rad", "mounting rotation",
    prior=Statement("rotation_rad", _deg(0.2), ("uncertainty.rotation_deg",), option="u_rotation_deg", convert=_deg),
    of_reference=True,
)  # fmt: skip
TRANSVERSE = Kind(
    "transverse motion", "1", "transverse motion",
    prior=Statement(
        "transverse", 1e-2, ("uncertainty.transverse_motion_pct",), option="u_transverse_motion_pct", convert=_percent
    ),
)  # fmt: skip

# --- the tables

KINDS: Mapping[str, Kind] = {kind.name: kind for kind in list(vars().values()) if isinstance(kind, Kind)}
# Not unknowns of a state, but what differs from window to window: it is in the weight of the windows' rows.
BETWEEN_WINDOWS = (
    Statement("offset_mps2", 0.05, ("uncertainty.offset_mps2",), option="u_offset_mps2"),
    Statement("lag_window_s", 0.0, ("uncertainty.lag_window_s",)),  # what clock models leave, beyond what data show
)
OF_SENSOR = (SENSITIVITY, OFFSET, OFFSET_RATE, SENSITIVITY_TEMPERATURE, OFFSET_TEMPERATURE)
PRIORS = by_name([s for k in KINDS.values() if k not in OF_SENSOR for s in k.statements] + list(BETWEEN_WINDOWS))
WALKS = by_name([s for k in OF_SENSOR for s in k.statements] + [k.walk for k in KINDS.values() if k.walk is not None])

S_AND_Q = tuple(Quantity(name, SENSITIVITY if k < 9 else OFFSET) for k, name in enumerate(PARAMETERS))
RATES = ("Qx_rate", "Qy_rate", "Qz_rate")  # output unit a day
MAIN_TEMPERATURE = ("Sx_T1", "Sy_T1", "Sz_T1")  # of a row of S, relative per K


def offset_temperature(power: int) -> tuple[str, str, str]:
    """Names of the coefficients of Q on (T - T0)^power, output unit per K^power."""
    return f"Qx_T{power}", f"Qy_T{power}", f"Qz_T{power}"
