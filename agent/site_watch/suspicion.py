"""What is suspected of a sensor, in words, and how it enlarges the uncertainty of the calibration in force.

The calibration in force keeps its value and its U. A suspected change that is not corrected adds its square to the
variance (GUM F.2.4.5): the enlarged U holds the change itself and U of it.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.config.files import read_file
from agent.core.events import CalibrationUpdate
from agent.site_watch.source import WatchError
from calib.model import Array
from calib.site_watch.verdicts import COVERAGE, NAMES, SensorVerdict
from calib.site_watch.witnesses import Witness

DAY_NS = 86_400 * 10**9
SOURCE = "suspected change"  # of a budget
LARGEST_FILE = 64 << 20  # bytes of a file of verdicts; a sensor has 2 kB
# Of calib.site_watch.together.DIRECTIONS; the last is of a gateway (direction -1).
AXES_OF = ("x", "y", "z", "xyz", "x", "y", "z", "xyz")
OTHER = ", or that of the other of two sensors against it: which one is not seen"
TOLD_UNITS = {"turn": ("°", math.degrees(1.0)), "": (" %", 100.0)}


class ToldWitness(msgspec.Struct):
    """What a witness says; `size` and `expanded_uncertainty` are None where it tells none."""

    name: str
    says: str
    size: float | None = None
    expanded_uncertainty: float | None = None


class Suspicion(msgspec.Struct):
    """A change that the site tells of a sensor: of the sensitivity of `axes` (x, y, z or xyz), relative; or a `turn`
    about one axis, in rad. U with k = 2; dates of UTC. `visit_information_nat`: what a visit of the sensor would tell.
    `one_of_two`: the change is of this sensor, or the opposite one of the only other sensor that tells anything.
    """

    gateway: str
    sensor: str
    axes: str
    turn: bool
    size: float
    expanded_uncertainty: float
    since: str
    earliest: str
    latest: str
    witnesses: list[ToldWitness]
    text: str
    visit_information_nat: float | None = None
    one_of_two: bool = False

    def enlarged(self, sensitivity: Array, covariance: Array) -> Array:
        """The covariance (12, 12) of S and Q with the suspected change; `sensitivity` (3, 3): S in force.

        S that is true is S (1 + size D), with D the axes, or the small turn, in the frame of the corrected
        acceleration.
        """
        D = np.zeros((3, 3))
        at = ["xyz".index(axis) for axis in self.axes]
        if self.turn:
            (w,) = at
            D[(w + 1) % 3, (w + 2) % 3], D[(w + 2) % 3, (w + 1) % 3] = 1.0, -1.0
        else:
            D[at, at] = 1.0
        moved = np.append((sensitivity @ D).ravel(), np.zeros(3))
        variance = self.size**2 + (self.expanded_uncertainty / COVERAGE) ** 2
        return np.asarray(covariance + variance * np.outer(moved, moved))

    @property
    def directions(self) -> NDArray[np.bool_]:
        """(3,) whether the sensitivities to x, y, z change: the columns of S."""
        named = np.isin(list("xyz"), list(self.axes))
        return np.asarray(~named if self.turn else named)

    @property
    def span_utc_ns(self) -> tuple[int, int]:
        """From the begin of the first day on which the change may have come to the end of the last one."""
        return _ns(self.earliest), _ns(self.latest) + DAY_NS

    def holds_of(self, made_utc_ns: int) -> bool:
        """Whether a calibration was made before the change; one that was made after it has found it."""
        return made_utc_ns <= _ns(self.latest)

    def update(self, update: CalibrationUpdate) -> CalibrationUpdate:
        """A result that tells the calibration in force, with the enlarged uncertainty where it is of a time after the
        change; else as it is."""
        if update.t_utc_ns < _ns(self.earliest) or not self.holds_of(update.date_utc_ns):
            return update
        before = np.array(update.covariance)
        covariance = self.enlarged(np.array(update.sensitivity), before)
        added = np.diag(covariance) - np.diag(before)
        u = np.sqrt(np.square(update.standard_uncertainty) + added)
        budget = update.budget and update.budget | {SOURCE: np.sqrt(added).tolist()}
        return msgspec.structs.replace(
            update, covariance=covariance.tolist(), standard_uncertainty=u.tolist(), budget=budget
        )

    def enlarged_u_pct(self, u_pct: float, axis: str) -> float:
        """U in % of the main sensitivity of `axis` with the suspected change; `u_pct`: U in force."""
        if self.turn or axis not in self.axes:
            return u_pct
        return 100.0 * math.sqrt((u_pct / 100.0) ** 2 + (COVERAGE * self.size) ** 2 + self.expanded_uncertainty**2)


class _Sensor(msgspec.Struct):
    suspected: Suspicion | None = None


class _Verdicts(msgspec.Struct):
    until: str
    sensors: list[_Sensor]


_VERDICTS = msgspec.json.Decoder(_Verdicts)  # made during the import, as agent.delivery.record says


def suspicions_in(path: Path) -> list[Suspicion]:
    """All suspicions in a file of `fieldcal fleet watch --json`. Raises WatchError with the file and what is wrong."""
    try:
        told = _VERDICTS.decode(read_file(path, LARGEST_FILE))
    except OSError as error:
        raise WatchError(f"{path}: {error.strerror or error}") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise WatchError(f"{path}: not a result of `fieldcal fleet watch --json`: {str(error)[:200]}") from None
    found = [one.suspected for one in told.sensors if one.suspected is not None]
    for one in found:
        numbers = one.size, one.expanded_uncertainty
        axes = one.axes in (("x", "y", "z") if one.turn else ("x", "y", "z", "xyz"))
        try:
            list(map(_ns, (one.since, one.earliest, one.latest)))
        except ValueError:
            raise WatchError(f"{path}: a date of {one.gateway}/{one.sensor} is none of a calendar") from None
        if not axes or not all(math.isfinite(value) and abs(value) < 10.0 for value in numbers):
            raise WatchError(f"{path}: what is suspected of {one.gateway}/{one.sensor} is not a change of x, y or z")
    return found


def suspicion_of(path: Path, sensor: str, gateway: str = "") -> Suspicion | None:
    """What is suspected of a sensor; None where nothing is. `gateway`: "" where it is not known.

    Raises WatchError, also where several gateways have a sensor of this name.
    """
    found = [one for one in suspicions_in(path) if one.sensor == sensor and gateway in ("", one.gateway)]
    if len(found) > 1:
        raise WatchError(
            f"{path}: {len(found)} gateways have a suspected sensor {sensor}; nothing here names the gateway"
        )
    return found[0] if found else None


def sentence(told: SensorVerdict) -> str:
    """A suspected change with its witnesses, in words."""
    what = NAMES[told.direction] if told.kind != "gateway" else "sensitivity of all sensors of its gateway"
    if told.kind == "turn":
        change = f"{what} by {sized(told)}"
    else:
        change = f"{what} has {'fallen' if told.size < 0.0 else 'risen'} by {sized(told).lstrip('+-')}"
    heard = [_heard(one) for one in told.witnesses] or [f"the structure says so ({told.statistic:.1f} u)"]
    other = OTHER if told.kind == "one of two" else ""
    return f"{change} since {since(told)}{other}: {', '.join(heard)}"


def frequency_sentence(told: SensorVerdict) -> str:
    """A natural frequency that has changed, in words."""
    moved = "fallen" if told.size < 0.0 else "risen"
    return f"{told.what}, has {moved} by {sized(told).lstrip('+-')} since {since(told)}: the structure has changed"


def _heard(one: Witness) -> str:
    name = f"the {one.name}" if one.name in ("structure", "self-test") else one.name
    if one.says == "silent":
        return f"{name} is silent"
    if one.says == "contradicts":
        return f"{name} contradicts it ({100.0 * one.size:+.2f} % ± {100.0 * COVERAGE * one.u:.2f} %)"
    if one.name == "noise":
        return f"noise has changed too ({100.0 * one.size:+.0f} %)"
    return f"{name} says so ({abs(one.size) / one.u:.1f} u)"


def witness_of(one: Witness) -> ToldWitness:
    """A witness as JSON has it."""
    known = math.isfinite(one.u)
    return ToldWitness(one.name, one.says, one.size if known else None, COVERAGE * one.u if known else None)


def relative(told: SensorVerdict) -> tuple[float, float]:
    """Size and U of a verdict as a part of the sensitivity; the watch tells its logarithm. An angle or a noise as it
    is.
    """
    if told.kind in ("sensitivity", "one of two", "gateway", "common", "structure"):
        return math.expm1(told.size), math.exp(told.size) * told.U
    return told.size, told.U


def sized(told: SensorVerdict) -> str:
    """The size with U; "" where there is none."""
    if not math.isfinite(told.U):
        return ""
    unit, factor = TOLD_UNITS.get(told.kind, TOLD_UNITS[""])
    size, U = relative(told)
    return f"{factor * size:+.2f} ± {factor * U:.2f}{unit}"


def since(told: SensorVerdict) -> str:
    """The date with its reach in days; "" where there is none."""
    if told.since < 0:
        return ""
    reach = max(told.latest - told.since, told.since - told.earliest, 1)
    return f"{date(told.since)} ± {reach} d"


def _ns(day: str) -> int:
    """The begin of a day of UTC, in ns since 1970."""
    return int(datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp()) * 10**9


def date(day: int) -> str:
    """The date of a day since 1970."""
    return (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(days=day)).date().isoformat()
