"""The measurement result of a calibration (VIM 2.9): S and Q with U, and what else tells whether to use them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from calib.estimate.axes import silent_directions
from calib.estimate.response_told import BandSensitivity
from calib.model import Array, Calibration, Window
from calib.output_unit import shown_in
from calib.rounding import KNOWN_BEFORE, from_to, plus_minus

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
class MeasurementResult:
    """S and Q with U, and all that was seen. If the data are refused, `calibration` is None and `reasons` say why.

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
        return silent_directions(np.reshape(self.more.get("unexcited_directions", ()), (-1, 3)))

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
