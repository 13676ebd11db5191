"""The outcome of a calibration, and the JSON object of docs/calibrate.md."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from calib import __version__
from calib.estimate.axes import where_nothing_moved
from calib.estimate.response_told import BandSensitivity
from calib.model import Array, Calibration, Window
from calib.output_unit import shown_in
from calib.rounding import KNOWN_BEFORE, from_to, plus_minus

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, slots=True)
class NuisanceValue:
    """A nuisance after the adjustment."""

    name: str
    value: float
    standard_uncertainty: float
    unit: str

    def cell(self, coverage_factor: float) -> str:
        """The value ± U with its unit; a unit of 1 is not told."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return plus_minus(self.value, coverage_factor * self.standard_uncertainty) + unit


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Outcome:
    """The outcome of a calibration. If the data are refused, `calibration` is None and `reasons` say why.

    `unit` is the sensor's output unit, "" where nothing tells it. `warnings`: what a reader must see before S and Q.
    Arrays of 12 are in the order of calib.model.PARAMETERS: S row by row, then Q. They are read-only.
    """

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
    unit: str = ""
    warnings: tuple[str, ...] = ()
    more: Mapping[str, Any] = field(default_factory=dict)  # further members of the JSON object

    @property
    def status(self) -> str:
        """ "valid" or "refused"."""
        return "refused" if self.reasons else "valid"

    @property
    def values(self) -> Array:
        """(12,) S row by row, then Q; NaN where the data are refused or do not determine it."""
        c = self.calibration
        return _fixed(np.full(12, np.nan) if c is None else np.append(c.sensitivity.ravel(), c.offset))

    @property
    def sensitivity(self) -> Array:
        """S (3, 3) in output unit per m/s2; NaN as in `values`."""
        return self.values[:9].reshape(3, 3)

    @property
    def offset(self) -> Array:
        """Q (3,) in output unit; NaN as in `values`."""
        return self.values[9:]

    @property
    def covariance(self) -> Array:
        """(12, 12); NaN as in `values`."""
        return _fixed(np.full((12, 12), np.nan) if self.calibration is None else self.calibration.covariance)

    @property
    def standard_uncertainty(self) -> Array:
        """(12,) standard uncertainties of `values`."""
        return _fixed(np.full(12, np.nan) if self.calibration is None else self.calibration.standard_uncertainty)

    @property
    def expanded_uncertainty(self) -> Array:
        """(12,) `coverage_factor` times the standard uncertainties."""
        return _fixed(self.coverage_factor * self.standard_uncertainty)

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(12,) whether the data determine each parameter."""
        return _fixed(np.zeros(12, dtype=bool) if self.calibration is None else self.calibration.determined)

    @property
    def reference_frequency_hz(self) -> float | None:
        """The frequency at which S holds; 0 where only rests were seen; None where the method has none."""
        told: float | None = self.more.get("reference_frequency_hz")
        return told

    @property
    def where_it_holds(self) -> str:
        """The frequency at which S holds, why where it is 0 beside motion, the band in which S is right, and that to
        which the motion was limited, as a sentence; "" where nothing is told."""
        if self.reference_frequency_hz is None:
            return ""
        told = f"S holds at {self.reference_frequency_hz:.3g} Hz"
        if not self.reference_frequency_hz and any(w.used and w.kind == "motion" for w in self.windows):
            return f"{told}, told by rests alone: motion tells it less well at its frequency (`reference_frequency_hz`)"
        band, limited = self.more.get("valid_band_hz"), self.more.get("band_hz")
        within = f"; from {from_to(*band)} Hz it is right within a third of U" if band else ""
        used = f"; only motion from {from_to(*limited)} Hz was used" if limited else ""
        return f"{told}{within}{used}"

    @property
    def where_nothing_moved(self) -> str:
        """The directions that nothing excited, as a sentence; "" where all were."""
        return where_nothing_moved(np.reshape(self.more.get("unexcited_directions", ()), (-1, 3)))

    @property
    def response(self) -> tuple[BandSensitivity, ...]:
        """S in bands of frequency, with the lag taken out; also where S is refused. Empty where nothing is known."""
        return tuple(
            BandSensitivity(
                band["low_hz"], band["high_hz"], _fixed(band["sensitivity_re"] + 1j * band["sensitivity_im"]),
                _fixed(band["standard_uncertainty"]),
            )
            for band in self.more.get("response") or ()
        )  # fmt: skip

    def cells(self) -> list[str]:
        """(12,) each parameter as value ± U; with KNOWN_BEFORE where the data do not halve its prior uncertainty.

        In the units of `calib.output_unit.shown_in`: g/g and mg where the sensor's output is in g.
        """
        factors = shown_in(self.unit).factors
        values, expanded = (factors * each for each in (self.values, self.expanded_uncertainty))
        told = zip(values.tolist(), expanded.tolist(), self.determined.tolist(), strict=True)
        return [_cell(*each) for each in told]

    def __repr__(self) -> str:
        """The status, S and Q with U, and what else tells whether to use them: few lines."""
        from calib.recorded.told import lines_of

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
        from calib.recorded.html import html_of

        return html_of(self)


def _fixed(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """A copy that cannot be written to."""
    found = array.copy()
    found.setflags(write=False)
    return found


def _cell(value: float, expanded: float, determined: bool) -> str:
    if not math.isfinite(value):
        return "not determined"
    text = "0" if value == expanded == 0.0 else plus_minus(value, expanded)  # 0 because the frame was chosen so
    return text if determined else f"{text} {KNOWN_BEFORE}"


def nothing_used(windows: Sequence[Window], rate_hz: float, method: str) -> Outcome:
    """The outcome if no window can be used. Its reason names the number of windows, and why the first is not used."""
    wanted = [w for w in windows if w.kind != "quiet"] or windows
    first = f"; the first of them ({wanted[0].pose.position}): {wanted[0].reason}" if wanted else ""
    return Outcome(None, (f"none of the {len(wanted)} windows can be used{first}",), windows, rate_hz, method)


def as_json(outcome: Outcome) -> str:
    """One JSON object, with null for values that are not known."""
    import msgspec

    return msgspec.json.encode(plain(as_object(outcome))).decode()


def as_object(outcome: Outcome) -> dict[str, Any]:
    """The members of the JSON object: those that every outcome has, then those of the method."""
    c = outcome.calibration
    expanded = _parts(outcome.expanded_uncertainty)
    return {
        **_parts(outcome.values),
        "standard_uncertainty": _parts(outcome.standard_uncertainty),
        "expanded_uncertainty": {**expanded, "coverage_factor": outcome.coverage_factor},
        "covariance": outcome.covariance,
        "determined": _parts(outcome.determined),
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
