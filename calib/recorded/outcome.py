"""The outcome of a calibration, and the JSON object of docs/calibrate.md."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from calib import __version__
from calib.model import Array, Calibration, Window


@dataclass(frozen=True, slots=True)
class NuisanceValue:
    """A nuisance after the adjustment."""

    name: str
    value: float
    standard_uncertainty: float
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """The outcome of a calibration. If the data are refused, `calibration` is None and `reasons` say why."""

    calibration: Calibration | None
    reasons: tuple[str, ...]
    windows: Sequence[Window]
    rate_hz: float
    method: str
    coverage_factor: float = 2.0
    uncertainty_kind: str = ""
    nuisances: Sequence[NuisanceValue] = ()
    lag_s: float | None = None
    rank: int | None = None
    residual_sd: Sequence[float] | None = None
    statistics: Mapping[str, Any] = field(default_factory=dict)
    more: Mapping[str, Any] = field(default_factory=dict)  # further members of the JSON object


def nothing_used(windows: Sequence[Window], rate_hz: float, method: str) -> Outcome:
    """The outcome if no window can be used. Its reason names the number of windows, and why the first is not used."""
    wanted = [w for w in windows if w.kind != "quiet"] or windows
    first = f"; the first of them ({wanted[0].pose.position}): {wanted[0].reason}" if wanted else ""
    return Outcome(None, (f"none of the {len(wanted)} windows can be used{first}",), windows, rate_hz, method)


def as_json(outcome: Outcome) -> str:
    """One JSON object, with null for values that are not known."""
    return msgspec.json.encode(plain(as_object(outcome))).decode()


def as_object(outcome: Outcome) -> dict[str, Any]:
    """The members of the JSON object: those that every outcome has, then those of the method."""
    c = outcome.calibration
    nothing = np.full(12, np.nan)
    values = nothing if c is None else np.append(c.sensitivity.ravel(), c.offset)
    u = nothing if c is None else c.standard_uncertainty
    expanded = _parts(outcome.coverage_factor * u)
    return {
        **_parts(values),
        "standard_uncertainty": _parts(u),
        "expanded_uncertainty": {**expanded, "coverage_factor": outcome.coverage_factor},
        "covariance": np.full((12, 12), np.nan) if c is None else c.covariance,
        "determined": _parts(np.zeros(12, dtype=bool) if c is None else c.determined),
        "nuisances": {
            n.name: {"value": n.value, "standard_uncertainty": n.standard_uncertainty, "unit": n.unit}
            for n in outcome.nuisances
        },
        "lag_s": outcome.lag_s,
        "rate_hz": outcome.rate_hz,
        "status": "refused" if outcome.reasons else "valid",
        "reasons": list(outcome.reasons),
        "windows": [_window(w) for w in outcome.windows],
        "statistics": dict(outcome.statistics),
        "version": __version__,
        "method": outcome.method,
        "uncertainty_kind": outcome.uncertainty_kind,
        "degrees_of_freedom": None if c is None else c.degrees_of_freedom,
        "rank": outcome.rank,
        "residual_sd": outcome.residual_sd,
        **outcome.more,
    }


def _parts(values: Array | np.ndarray[Any, np.dtype[np.bool_]]) -> dict[str, Any]:
    """S and Q from (12,) in the order of calib.model.PARAMETERS."""
    return {"sensitivity": values[:9].reshape(3, 3), "offset": values[9:]}


def _window(window: Window) -> dict[str, Any]:
    return {
        "start_s": window.start_s,
        "stop_s": window.stop_s,
        "used": window.used,
        "reason": window.reason,
        "points": window.points,
        "left_out": window.left_out,
        "kind": window.kind,
        "position": window.pose.position,
        "numbers": dict(window.numbers),
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
