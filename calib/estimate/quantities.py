"""The table of unknowns: each kind of quantity that can be estimated, with all that the estimators need to know of it.

A new unknown needs one `Kind` in this file and, in calib.estimate.terms, its effect on the inputs. Names are for people
and for looking up; two places decide by them: a step of lags alone moves neither S nor Q (State._moving_steps), and
rates are not among what may explain a window that is held.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

import numpy as np

from calib.model import PARAMETERS

# The window equations contain products of S with other unknowns. Up to this change of an unknown (relative for S, rad
# for an angle) the products count as linear, and the windows need not be linearised again. The error is then 5e-6 of S
# if an angle is off by 0.3 deg.
STRAIGHT = 1e-3
STRAIGHT_LAG_S = 5e-5  # at 10 Hz (omega lag)^2 / 2 is 5e-6 as well
LINEAR = np.inf  # for an unknown that is not multiplied by S
YEAR_DAYS = 365.25


def from_deg(angle_deg: float) -> float:
    """An angle in rad."""
    return float(np.deg2rad(angle_deg))


def from_percent(share_pct: float) -> float:
    """A share of 1."""
    return share_pct / 100.0


@dataclass(frozen=True, slots=True)
class Statement:
    """A number that is stated before any data: a standard uncertainty, a mean, or the SD of a random walk.

    `name`: the attribute of `calib.estimate.nuisances.Priors` or `calib.estimate.wander.Wander`, with its unit.
    `default`: its value if it is not stated.
    """

    name: str
    default: float = 0.0


Loosening = Literal["jump", "lean", "line", "filter", "remount"]


@dataclass(frozen=True, slots=True)
class Kind:
    """The properties that all unknowns of one kind have in common.

    `name`: identifies the kind in a snapshot.
    `unit`: unit of the value; "" for S, Q and their coefficients, whose unit contains the sensor's output unit.
    `source`: the line of the uncertainty budget that its prior belongs to; that of its walk and its steps as well, but
    where `walked_source` names another.
    `prior`, `mean`: standard uncertainty and value before any data; without `mean` the value is 0. If `prior` is None,
    calib.estimate.unknowns gets the uncertainty as an argument (S, Q, coefficients of temperature).
    `walk`: SD of its random walk after one day; None for a constant.
    `in_output_unit`: `walk` and `straight` must be multiplied by the sensor's output unit per m/s2.
    `loosened_by`: the events that may change it at once, so that its uncertainty is enlarged: a "jump" of the sensor
    that further windows confirmed, a "lean" of a fixed mount, a new "line" (a device or its wiring was started again),
    another "filter", a "remount" (the sensor or the reference was mounted again, or the stated poses changed).
    `of_reference`: it belongs to the reference. It stays in the state when another reference takes its place, and is
    used again when that reference comes back.
    `of_certificate`: it is an error of the reference's certificate, so that all results with this reference share it.
    The lag and the response belong to both instruments, the rotation to the mount.
    `of_place`: it belongs to the place of the reference. The next reference there takes it over, and may differ in it:
    nobody states how alike two references in one place are, so S owes its direction to the first of them.
    `straight`: the change up to which its product with S counts as linear; LINEAR if it is not multiplied by S.
    `stated`: the prior is a statement that the data may contradict; if false, only the data determine the value.
    `per_k`: its effect is multiplied by the temperature of a window "above" that of S and Q, or by how far the body of
    the sensor is "behind" it (calib.windows.record.Record.behind_k).
    `since_certificate`: it grows from the date of the reference's certificate on, without a limit. `prior` is then its
    standard uncertainty after one year; a state begins with that of the time since this date (calib.estimate.unknowns).
    """

    name: str
    unit: str = ""
    source: str = ""
    prior: Statement | None = None
    mean: Statement | None = None
    walk: Statement | None = None
    in_output_unit: bool = False
    loosened_by: tuple[Loosening, ...] = ()
    of_reference: bool = False
    of_certificate: bool = False
    of_place: bool = False
    straight: float = STRAIGHT
    stated: bool = True
    per_k: Literal["", "above", "behind"] = ""
    since_certificate: bool = False
    walked_source: str = ""

    @property
    def statements(self) -> list[Statement]:
        """The statements on its value before any data: standard uncertainty and mean."""
        return [s for s in (self.prior, self.mean) if s is not None]


@dataclass(frozen=True, slots=True)
class Quantity:
    """One unknown: its name, its kind, its position ("" if it is common to all positions), and its owner.

    The owner is the identity of the reference to which the unknown belongs, its place for an unknown of the place, and
    "" for all other unknowns. Two references have unknowns of the same name; `key` tells them apart. `centre`: it is
    the value about which the unknown walks (calib.estimate.unknowns).
    """

    name: str
    kind: Kind
    position: str = ""
    owner: str = ""
    centre: bool = False

    @property
    def key(self) -> str:
        """Identifies the unknown in a joint state."""
        return (f"{self.name} of {self.owner}" if self.owner else self.name) + (", centre" if self.centre else "")


@dataclass(frozen=True, init=False)
class StatedValues:
    """Values for a table of statements; each value is an attribute with the name of its statement."""

    table: ClassVar[Mapping[str, Statement]] = {}
    values: Mapping[str, float]

    def __init__(self, values: Mapping[str, float] | None = None, **stated: float) -> None:
        """`stated` overrides `values`, and `values` override the defaults. Raises TypeError for an unknown name."""
        told = {**(values or {}), **stated}
        unknown = [name for name in told if name not in self.table]
        if unknown:
            raise TypeError(f"{type(self).__name__} has no {', '.join(unknown)}; it has {', '.join(self.table)}")
        object.__setattr__(self, "values", {name: told.get(name, s.default) for name, s in self.table.items()})

    @classmethod
    def none(cls) -> Self:
        """All values 0."""
        return cls(dict.fromkeys(cls.table, 0.0))

    def __getattr__(self, name: str) -> float:
        values: Mapping[str, float] = self.__dict__.get("values", {})
        if name not in values:
            raise AttributeError(f"{type(self).__name__} has no {name}")
        return values[name]

    def of(self, statement: Statement | None) -> float:
        """The value of a statement; 0 for None."""
        return 0.0 if statement is None else self.values[statement.name]


def by_name(statements: Iterable[Statement]) -> dict[str, Statement]:
    """The table of these statements, by name."""
    return {s.name: s for s in statements}


# --- the sensor

PRIOR, WALK, TEMPERATURE = "prior of S and Q", "walks and steps of S and Q", "temperature"
SENSITIVITY = Kind(
    "sensitivity",
    source=PRIOR,
    walked_source=WALK,
    walk=Statement("sensitivity", 1.8e-4),
    in_output_unit=True,
    loosened_by=("jump",),
)
TILT_WALK = Statement("tilt_rad", 3.5e-5)
OFFSET = Kind(
    "offset",
    source=PRIOR,
    walked_source=WALK,
    walk=Statement("offset_mps2", 0.002),
    in_output_unit=True,
    loosened_by=("jump",),
    straight=LINEAR,
)
OFFSET_RATE = Kind(
    "offset rate",
    source="rates of S and Q",
    prior=Statement("offset_rate_mps2", 0.001),
    walk=Statement("offset_rate_walk_mps2", 2e-5),
    in_output_unit=True,
    straight=LINEAR,
)
# Comes into a state only when a drift of S was found, with the standard uncertainty that this drift has.
SENSITIVITY_RATE = Kind("sensitivity rate", source=OFFSET_RATE.source, in_output_unit=True, straight=LINEAR)
SENSITIVITY_TEMPERATURE = Kind(
    "sensitivity over temperature",
    source=TEMPERATURE,
    in_output_unit=True,
    straight=0.1 * STRAIGHT,  # at 10 K that of S itself
    per_k="above",
)
# What depends on temperature follows the body of sensor and reference, and the thermometer of a chip is ahead of it.
SENSITIVITY_BEHIND = replace(SENSITIVITY_TEMPERATURE, name="sensitivity behind temperature", per_k="behind")
OFFSET_TEMPERATURE = Kind("offset over temperature", source=TEMPERATURE, straight=LINEAR)
OFFSET_BEHIND = Kind("offset behind temperature", source=TEMPERATURE, straight=LINEAR, per_k="behind")
SENSOR_CORNER = Kind(
    "sensor corner", "Hz", "corner frequency",
    prior=Statement("sensor_corner_hz"),
    mean=Statement("sensor_corner_at_hz"),
)  # fmt: skip
LAG = Kind(
    "lag", "s", "lag",
    # Low-pass filters of sensors and errors of clock fits cause lags of 0.5 to 15 ms. The lags of sensor and reference
    # are one unknown: the time by which the sensor's indications come after the reference's.
    prior=Statement("lag_s", 0.02),
    mean=Statement("lag_at_s"),
    loosened_by=("line", "remount"), of_reference=True, straight=STRAIGHT_LAG_S, stated=False,
)  # fmt: skip
LAG_OF_AXIS = Kind(
    "lag of axis", "s", "lag",
    # All axes share filter and clock, but a multiplexed converter samples them 0.1 ms apart.
    prior=Statement("lag_axis_s", 2e-4),
    of_reference=True, straight=STRAIGHT_LAG_S, stated=False,
)  # fmt: skip

# --- the position of the sensor

THETA = Kind(
    "theta", "rad", "theta common",
    prior=Statement("theta_rad", from_deg(0.2)),
    loosened_by=("remount",),
)  # fmt: skip
THETA_BY_POSITION = Kind(
    "theta by position", "rad", "theta by position",
    prior=Statement("theta_position_rad"),
    loosened_by=("remount",),
)  # fmt: skip
ALPHA_COMMON = Statement("alpha_common_rad", from_deg(0.1))
ANGLE = Statement("angle_rad", from_deg(0.2))
ALPHA = Kind("alpha", "rad", "alpha common", prior=ALPHA_COMMON, loosened_by=("remount",))
ALPHA_BY_POSITION = Kind("alpha by position", "rad", "alpha by position", prior=ANGLE, loosened_by=("remount",))
DIRECTION = Kind("direction", "rad", "direction common", prior=ALPHA_COMMON, loosened_by=("remount",))
DIRECTION_BY_POSITION = Kind(
    "direction by position", "rad", "direction by position", prior=ANGLE, loosened_by=("remount",)
)
GRAVITY_DIRECTION = Kind(  # only beside a tri-axial reference, whose rotation is an unknown of its own
    "gravity direction by position", "rad", "direction by position",
    prior=Statement("gravity_direction_rad", from_deg(0.2)),
    walk=TILT_WALK, loosened_by=("lean", "remount"),
)  # fmt: skip
LEAN = Kind(
    # Of a fixed mount with the sensor and its reference on it: gravity turns, the direction of motion does not.
    "lean", "rad", "tilt",
    prior=Statement("lean_rad"),
    walk=TILT_WALK, loosened_by=("lean", "remount"),
)  # fmt: skip
TILT = Kind(
    "tilt", "rad", "tilt",
    prior=Statement("tilt_rad"),
    walk=TILT_WALK,
    loosened_by=("remount",),
)  # fmt: skip
OFFSET_BY_POSITION = Kind(
    "offset by position", "m/s2", "offset by position",
    prior=Statement("offset_position_mps2"),
    straight=LINEAR,
    loosened_by=("remount",),
)  # fmt: skip
GRAVITY = Kind(
    "gravity", "m/s2", "gravity",
    prior=Statement("gravity_mps2", 0.03),
    straight=10.0 * STRAIGHT,
)  # fmt: skip

# --- the reference

REFERENCE = Kind(
    "reference sensitivity", "1", "reference sensitivity",
    prior=Statement("reference", 1e-3),
    of_reference=True, of_certificate=True,
)  # fmt: skip
REFERENCE_DRIFT = Kind(  # beside the constant error of the certificate, whose prior can then be exchanged exactly
    "reference drift", "1", "reference drift",
    prior=Statement("reference_drift"),
    walk=Statement("reference_drift"),
    of_reference=True, of_certificate=True, since_certificate=True,
)  # fmt: skip
REFERENCE_TEMPERATURE = Kind(  # its certificate holds at the temperature of S and Q
    "reference over temperature", "1/K", "reference over temperature",
    prior=Statement("reference_per_k"),
    of_reference=True, of_certificate=True, per_k="above", straight=0.1 * STRAIGHT,
)  # fmt: skip
REFERENCE_TRANSVERSE = Kind(  # of a reference with several axes: by how much each shows of what is along another
    "reference transverse sensitivity", "1", "transverse sensitivity of the reference",
    prior=Statement("reference_transverse"),
    of_reference=True, of_certificate=True,
)  # fmt: skip
REFERENCE_CORNER = Kind(
    "reference corner", "Hz", "corner frequency",
    prior=Statement("reference_corner_hz"),
    mean=Statement("reference_corner_at_hz"),
    of_reference=True, of_certificate=True,
)  # fmt: skip
RESPONSE = Kind(
    # Of both instruments together, as the lag is.
    "response", "1", "response over frequency",
    prior=Statement("response"), mean=Statement("response_at"),
    of_reference=True, straight=LINEAR, stated=False,  # calib.state.over_frequency sees whether it changed
    loosened_by=("filter",),
)  # fmt: skip
ROTATION = Kind(
    "mounting rotation", "rad", "mounting rotation",
    prior=Statement("rotation_rad", from_deg(0.2)),
    of_reference=True, of_place=True, loosened_by=("remount",),
)  # fmt: skip
TRANSVERSE = Kind(
    "transverse motion", "1", "transverse motion",
    prior=Statement("transverse", 1e-2),
    loosened_by=("remount",),
)  # fmt: skip

# --- the tables

KINDS: Mapping[str, Kind] = {kind.name: kind for kind in list(vars().values()) if isinstance(kind, Kind)}
# Scatter between windows is no unknown of a state: it is part of the weights of the windows.
BETWEEN_WINDOWS = (
    Statement("offset_mps2", 0.05),
    Statement("lag_window_s"),  # the data may show a larger one
)
OF_SENSOR = (
    SENSITIVITY, SENSITIVITY_RATE, OFFSET, OFFSET_RATE,
    SENSITIVITY_TEMPERATURE, OFFSET_TEMPERATURE, SENSITIVITY_BEHIND, OFFSET_BEHIND,
)  # fmt: skip
FREQUENCIES = (
    # See calib.estimate.nuisances.Priors.
    *map(Statement, ("known_size", "known_u", "reference_share", "reference_share_below")),
    Statement("reference_frequency_hz"),  # at which S holds
)
PRIORS = by_name(
    [s for k in KINDS.values() if k not in OF_SENSOR for s in k.statements] + [*BETWEEN_WINDOWS, *FREQUENCIES]
)
WALKS = by_name([s for k in OF_SENSOR for s in k.statements] + [k.walk for k in KINDS.values() if k.walk is not None])

S_AND_Q = tuple(Quantity(name, SENSITIVITY if k < 9 else OFFSET) for k, name in enumerate(PARAMETERS))
RATES = ("Qx_rate", "Qy_rate", "Qz_rate")  # output unit a day; every state has them
ALL_RATES = (*(f"{name}_rate" for name in PARAMETERS[:9]), *RATES)  # of S and Q, in the order of PARAMETERS
SENSITIVITY_PER_K = tuple(f"{name}_T1" for name in PARAMETERS[:9])  # output unit per m/s2 and K
BEHIND = tuple(f"{name}_behind" for name in PARAMETERS)  # of S and Q, for each kelvin of `behind_k`


def offset_temperature(power: int) -> tuple[str, str, str]:
    """Names of the coefficients of Q on (T - T0)^power, output unit per K^power."""
    return f"Qx_T{power}", f"Qy_T{power}", f"Qz_T{power}"
