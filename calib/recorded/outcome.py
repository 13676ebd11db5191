"""The outcome of a calibration, and the JSON object of docs/calibrate.md."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from calib import __version__
from calib.model import Array, Window
from calib.recorded.html import html_of
from calib.recorded.measurement_result import MeasurementResult
from calib.recorded.told import lines_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Outcome(MeasurementResult):
    """The measurement result as text, as JSON and as a figure."""

    def __repr__(self) -> str:
        """The status, S and Q with U, and what else tells whether to use them: few lines."""
        used = sum(window.used for window in self.windows)
        told = [f"{self.status}: method {self.method}, {used} of {len(self.windows)} windows used"]
        told += [f"WARNING: {warning}" for warning in self.warnings]
        told += [f"refused: {reason}" for reason in self.reasons]
        return "\n".join([*told, *lines_of(self)])

    def to_json(self) -> str:
        """The JSON object of docs/calibrate.md, with null for what is not known."""
        return as_json(self)

    def plot(self) -> Figure:
        """S, Q, the response and the windows as a matplotlib figure. Raises ImportError without matplotlib."""
        try:
            from calib.recorded.plot import figure_of
        except ModuleNotFoundError as error:
            name = str(error.name).partition(".")[0]
            raise ImportError(f"plot() needs {name}, which is not installed; install it: pip install {name}") from error
        return figure_of(self)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return html_of(self)


def nothing_used(windows: Sequence[Window], rate_hz: float, method: str) -> Outcome:
    """The outcome if no window can be used. Its reason names the number of windows, and why the longest is not used."""
    wanted = [w for w in windows if w.kind != "quiet"] or windows
    longest = max(wanted, key=lambda w: w.stop_s - w.start_s, default=None)
    why = "" if longest is None else f"; the longest of them ({longest.pose.position}): {longest.reason}"
    return Outcome(None, (f"none of the {len(wanted)} windows can be used{why}",), windows, rate_hz, method)


def as_json(outcome: Outcome) -> str:
    """One JSON object, with null for values that are not known."""
    import msgspec

    return msgspec.json.encode(plain(as_object(outcome))).decode()


def as_object(outcome: Outcome) -> dict[str, Any]:
    """The members of the JSON object: those that every outcome has, then those of the method."""
    c = outcome.calibration
    expanded = parts_of(outcome.expanded_uncertainty)
    return {
        **parts_of(outcome.values),
        "standard_uncertainty": parts_of(outcome.standard_uncertainty),
        "expanded_uncertainty": {**expanded, "coverage_factor": outcome.coverage_factor},
        "covariance": outcome.covariance,
        "determined": parts_of(outcome.determined),
        "nuisances": {
            n.name: {"value": n.value, "standard_uncertainty": n.standard_uncertainty, "unit": n.unit}
            for n in outcome.nuisances
        },
        "lag_s": outcome.lag_s,
        "rate_hz": outcome.rate_hz,
        "unit": outcome.unit or None,
        "status": outcome.status,
        "reasons": list(outcome.reasons),
        "warnings": list(outcome.warnings),
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


def parts_of(values: Array | np.ndarray[Any, np.dtype[np.bool_]]) -> dict[str, Any]:
    """S and Q from (12,), as the JSON object has them, in the order of calib.model.PARAMETERS."""
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
