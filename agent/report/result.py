"""One calibration in a report: the object that `fieldcal calibrate --json -` prints, or a recorded result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec.structs import asdict
from numpy.typing import NDArray

from agent.calibrate.origin import SourceFile
from agent.config.earlier import LARGEST_VALUE
from agent.core.events import CalibrationUpdate
from calib.estimate.axes import axis_warnings
from calib.excitation.windows import CALM
from calib.model import PARAMETERS, Array
from calib.output_unit import shown_in

Item = TypeVar("Item")
Row = tuple[float | None, float | None, float | None]
Matrix = tuple[Row, Row, Row]

MANY_DEGREES = 1e6  # of freedom: as infinitely many, since k differs from 2 by less than 3e-6
ROUNDED = 1e-6  # relative: results are written with all their digits
PLACES = {"sensitivity": (3, 3), "offset": (3,)}
# Members with their own place in the report. All further members of the object are shown in one more table.
SHOWN = frozenset(
    {
        "sensitivity", "offset", "standard_uncertainty", "expanded_uncertainty", "covariance", "determined",
        "degrees_of_freedom", "effective_degrees_of_freedom", "nuisances", "budget", "status", "reasons", "windows",
        "statistics", "options", "files", "shared_errors", "response", "warnings", "unit",
    }
)  # fmt: skip


class ResultError(ValueError):
    """The object is not a calibration result. The message names the field and what is wrong with it."""


class WindowVerdict(msgspec.Struct, frozen=True):
    """One window: its times in seconds since the first sample, and whether it was used or why not.

    `held`: it was not used, and further windows might have confirmed it; files have no such windows.
    """

    start_s: float
    stop_s: float
    used: bool
    reason: str
    points: int
    left_out: int = 0
    position: str = ""
    kind: str = ""
    held: bool = False

    @property
    def verdict(self) -> Literal["used", "held", "calm", "refused"]:
        """What became of it."""
        if self.used or self.held:
            return "used" if self.used else "held"
        return "calm" if self.kind == "quiet" or self.reason == CALM else "refused"


class ThirdOctave(msgspec.Struct, frozen=True):
    """The complex sensitivity in one third octave; None where it is not known."""

    low_hz: float
    high_hz: float
    sensitivity_re: Matrix | None
    sensitivity_im: Matrix | None
    standard_uncertainty: Matrix | None


class Frequencies(msgspec.Struct, frozen=True):
    """Where S holds, as the result tells it; None where it does not."""

    reference_frequency_hz: float | None = None
    valid_band_hz: tuple[float, float] | None = None
    response: tuple[ThirdOctave, ...] | None = None

    @property
    def bands(self) -> tuple[ThirdOctave, ...]:
        """Those that are known."""
        known = self.response or ()
        return tuple(b for b in known if b.sensitivity_re and b.sensitivity_im and b.standard_uncertainty)

    def times(self, factor: float) -> Frequencies:
        """The same with the sensitivity of each band multiplied."""
        bands = [
            ThirdOctave(b.low_hz, b.high_hz, *((factor * np.array(m, dtype=float)).tolist()
                 for m in (b.sensitivity_re, b.sensitivity_im, b.standard_uncertainty)))
            for b in self.bands
        ]  # fmt: skip
        return msgspec.structs.replace(self, response=tuple(bands))


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """S and Q with their uncertainties. Arrays of 12 are in the order of PARAMETERS; NaN: not known.

    `unit` is that of the indications, "" where the result does not say it. `degrees_of_freedom` (12,), NaN where they
    are not stated or without end. `budget` {source: (12,) standard uncertainty}. `files`: what the result was made
    from. `fields` is the object itself.
    """

    label: str
    values: Array
    standard_uncertainty: Array
    expanded_uncertainty: Array
    coverage_factor: Array  # (12,)
    covariance: Array
    determined: NDArray[np.bool_]
    degrees_of_freedom: Array
    lag_s: Array  # (3,), 0 if it is not known
    refused: bool
    reasons: tuple[str, ...]
    windows: tuple[WindowVerdict, ...]
    unit: str
    budget: Mapping[str, Array] = field(default_factory=dict)
    files: tuple[SourceFile, ...] = ()
    frequencies: Frequencies = field(default_factory=Frequencies)
    fields: Mapping[str, Any] = field(default_factory=dict)

    @property
    def sensitivity(self) -> Array:
        """(3, 3)."""
        return self.values[:9].reshape(3, 3)

    @property
    def offset(self) -> Array:
        """(3,)."""
        return self.values[9:]

    @property
    def in_display_units(self) -> CalibrationResult:
        """The same in the units in which people read S and Q, which `agent.report.units` names: g/g and mg for g."""
        factors = shown_in(self.unit).factors
        return replace(
            self,
            values=factors * self.values,
            standard_uncertainty=factors * self.standard_uncertainty,
            expanded_uncertainty=factors * self.expanded_uncertainty,
            covariance=np.outer(factors, factors) * self.covariance,
            budget={source: factors * u for source, u in self.budget.items()},
            frequencies=self.frequencies.times(float(factors[0])),
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a reader must see before S and Q."""
        return tuple(map(str, self.fields.get("warnings") or ()))

    @property
    def other_members(self) -> dict[str, Any]:
        """Members of the object that no other table shows."""
        return {name: value for name, value in self.fields.items() if name not in SHOWN}


def parse(fields: Mapping[str, Any], name: str) -> CalibrationResult:
    """The result from an object with the members that docs/calibrate.md describes. Raises ResultError.

    It is labelled by its method, by `name` where it does not say one.
    """
    if "sensitivity" not in fields or "status" not in fields:
        raise ResultError("the file is not a calibration result: its fields sensitivity and status are missing")
    values, u, expanded = (
        np.append(*_parts(part, where))
        for part, where in (
            (fields, ""),
            (fields.get("standard_uncertainty"), "standard_uncertainty."),
            (fields.get("expanded_uncertainty"), "expanded_uncertainty."),
        )
    )
    stated = fields.get("expanded_uncertainty") or {}
    factor = _array(stated.get("coverage_factor"), (12,), "expanded_uncertainty.coverage_factor")
    covariance = _array(fields.get("covariance"), (12, 12), "covariance")
    _check_uncertainties(values, u, expanded, factor, covariance)
    method = fields.get("method")
    return CalibrationResult(
        label=f"Method {method}" if method else name,
        values=values,
        standard_uncertainty=u,
        expanded_uncertainty=expanded,
        coverage_factor=factor,
        covariance=covariance,
        determined=np.append(*_parts(fields.get("determined"), "determined.")) == 1.0,
        degrees_of_freedom=_freedom(fields),
        lag_s=np.nan_to_num(_array(fields.get("lag_s"), (3,), "lag_s")),
        refused=fields["status"] != "valid",
        reasons=tuple(str(reason) for reason in fields.get("reasons") or ()),
        windows=tuple(_list_of(WindowVerdict, fields.get("windows"), "windows")),
        unit=str(fields.get("unit") or fields.get("output_unit") or ""),
        budget={source: _source(part, f"budget.{source}") for source, part in (fields.get("budget") or {}).items()},
        files=tuple(_list_of(SourceFile, fields.get("files"), "files")),
        frequencies=_frequencies(fields),
        fields=fields,
    )


def _check_uncertainties(values: Array, u: Array, expanded: Array, factor: Array, covariance: Array) -> None:
    """Raises ResultError where u, U, their ratio and the covariance, as far as known, do not belong together."""
    if np.nanmax(np.abs(np.concatenate([values, u, covariance.ravel()])), initial=0.0) > LARGEST_VALUE:
        raise ResultError(f"a value is larger than {LARGEST_VALUE:g}")
    for name, stated in (("standard_uncertainty", u), ("expanded_uncertainty", expanded)):
        if (stated < 0.0).any():
            raise ResultError(f"field {name}: {np.nanmin(stated):g} is negative")
    for name, stated, expected in (
        ("expanded_uncertainty", expanded, factor * u),
        ("covariance", np.diag(covariance), u**2),
    ):
        apart = ~np.isclose(stated, expected, rtol=ROUNDED, atol=0.0)
        if (wrong := np.flatnonzero(apart & ~np.isnan(stated) & ~np.isnan(expected))).size:
            k = int(wrong[0])
            raise ResultError(
                f"field {name}: {stated[k]:g} for {PARAMETERS[k]}, where standard_uncertainty and coverage_factor give "
                f"{expected[k]:g}; do not edit a result"
            )


def from_update(
    update: CalibrationUpdate, windows: tuple[WindowVerdict, ...], versions: Mapping[str, str]
) -> dict[str, Any]:
    """A recorded calibration as an object with the members of `fieldcal calibrate --json -`."""
    u = np.array(update.standard_uncertainty)
    found = np.array(update.determined, dtype=bool)
    values = np.where(found, np.append(np.array(update.sensitivity), update.offset), np.nan)
    covariance = np.where(np.outer(found, found), np.array(update.covariance), np.nan)
    fields: dict[str, Any] = {
        **_split(values),
        "standard_uncertainty": _split(u),
        "expanded_uncertainty": _split(update.coverage_factor * u) | {"coverage_factor": update.coverage_factor},
        "covariance": covariance,
        "determined": _split(found),
        "nuisances": {},
        "lag_s": None,
        "rate_hz": None,
        "status": "valid",
        "reasons": [],
        "warnings": axis_warnings(values[:9].reshape(3, 3)),
        "windows": [asdict(window) for window in windows],
        "statistics": {},
        "version": versions.get("fieldcal", ""),
        "engine": update.by_engine,
        "method": update.method,
        "uncertainty_kind": update.uncertainty_kind,
        "output_unit": update.output_unit,
        "identity": update.identity,
        "sensor": update.sensor,
        "windows_in_solution": update.windows,
        "residual_sd": update.residual_sd,
        "reference_frequency_hz": update.reference_frequency_hz,
        "valid_band_hz": update.valid_band_hz or None,
        "sensitivity_at_0hz": asdict(update.sensitivity_at_0hz) if update.sensitivity_at_0hz.sensitivity else None,
        "response": [asdict(band) for band in update.response] or None,
        "shared_errors": [asdict(error) for error in update.shared_errors],
        "budget": update.budget,
        "degrees_of_freedom": update.degrees_of_freedom or None,
        "run_id": update.made[0],
        "sequence": update.made[1],
    }
    return {name: plain(value) for name, value in fields.items()}


def undetermined(reasons: tuple[str, ...], windows: tuple[WindowVerdict, ...]) -> dict[str, Any]:
    """The object for data that could be read but gave no calibration."""
    nothing = {"sensitivity": None, "offset": None}
    return {
        **nothing,
        "standard_uncertainty": nothing,
        "expanded_uncertainty": {**nothing, "coverage_factor": None},
        "covariance": None,
        "determined": nothing,
        "status": "refused",
        "reasons": list(reasons),
        "windows": [asdict(window) for window in windows],
    }


def plain(value: Any) -> Any:
    """Converts to types that JSON has. A number that is not finite becomes null."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _split(values: NDArray[Any]) -> dict[str, Any]:
    return {"sensitivity": values[:9].reshape(3, 3), "offset": values[9:]}


def _frequencies(fields: Mapping[str, Any]) -> Frequencies:
    try:
        return msgspec.convert(fields, Frequencies)
    except msgspec.ValidationError as error:
        raise ResultError(f"{error}; make the result again with `fieldcal calibrate`") from None


def _parts(part: Any, where: str) -> tuple[Array, Array]:
    part = part if isinstance(part, Mapping) else {}
    sensitivity, offset = (_array(part.get(name), shape, where + name) for name, shape in PLACES.items())
    return sensitivity.ravel(), offset


def _array(value: Any, shape: tuple[int, ...], where: str) -> Array:
    """Numbers as an array of this shape. A single number fills the array, null becomes NaN. Raises ResultError."""
    try:
        given = np.array(np.nan if value is None else value, dtype=object)
        array = np.where(given == None, np.nan, given).astype(float)  # noqa: E711 - elementwise
        if array.shape not in (shape, ()) or any(isinstance(text, str) for text in given.ravel()):
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        size = " x ".join(str(n) for n in shape)
        raise ResultError(f"field {where}: must be {size} numbers or null, not {_short(value)}") from None
    return np.broadcast_to(array, shape).copy()


def _freedom(fields: Mapping[str, Any]) -> Array:
    """The effective degrees of freedom (12,), on which the coverage factor rests; NaN where they are not told.

    Of an adjustment of files, `degrees_of_freedom` is a number: that of the type A part alone.
    """
    name = "effective_degrees_of_freedom"
    value = fields.get(name)
    if value is None:
        name = "degrees_of_freedom"
        value = fields.get(name)
        if fields.get("uncertainty_kind") == "combined" and isinstance(value, int | float):
            value = None
    told = np.append(*_parts(value, f"{name}.")) if isinstance(value, Mapping) else _array(value, (12,), name)
    return np.where(told > MANY_DEGREES, np.inf, told)


def _source(value: Any, where: str) -> Array:
    """Twelve numbers, from a list in the order of PARAMETERS or from an object with their names."""
    return _array([value.get(p) for p in PARAMETERS] if isinstance(value, Mapping) else value, (12,), where)


def _list_of(kind: type[Item], value: Any, where: str) -> list[Item]:
    try:
        return msgspec.convert(value or [], list[kind])  # type: ignore[valid-type]
    except msgspec.ValidationError as error:
        raise ResultError(f"field {where}: {error}") from None


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
