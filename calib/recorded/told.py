"""A result as lines of text: S and Q with U, where they hold, and what their uncertainty comes from.

Names of options are in `...`, as in the messages of calib.recorded.errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.estimate.quantities import BETWEEN_WINDOWS, KINDS
from calib.model import PARAMETERS, Array
from calib.output_unit import shown_in
from calib.recorded.measurement_result import MeasurementResult
from calib.recorded.options import STATED
from calib.rounding import KNOWN_BEFORE, aligned, plus_minus, rounded

AXES = "xyz"
MAIN, OFFSET = (0, 4, 8), (9, 10, 11)
MOST_SOURCES = 3
_FILTERS = "`sensor_filter`, `reference_filter`"
# What makes a source of the uncertainty smaller that no option states (calib.adjustment.budget).
_WAYS = {
    "type A": "longer or more windows, or stronger motion",
    "lag between windows": "longer windows, or one clock for both devices",
    "correction for the reference's noise": "stronger motion, or a reference with less noise",
    "slopes between windows": "more windows, or a mount that does not slip",
    "transverse motion, by other outputs": "motion in more modes, or a tri-axial reference",
    "whose noise it is": "stronger motion, or a reference with less noise",
    "known filters": "a smaller u in `sensor_filter`, `reference_filter`",
    "response between bands": _FILTERS,
    "response by axis": _FILTERS,
    "response over frequency": _FILTERS,
    "lag": "motion at more frequencies, or a delay in `sensor_filter`",
    "change within the recording": "the parts calibrated by themselves",
    "prior of S and Q": "motion in more directions, or a better `prior`",
}


@dataclass(frozen=True, slots=True)
class UncertaintySource:
    """A source of the uncertainty: its part of U of each parameter of `parameters_of`, and what makes it smaller."""

    name: str
    expanded: tuple[float, ...]
    way: str


def lines_of(result: MeasurementResult) -> Iterator[str]:
    """S and Q with U, their units, where S holds, and the largest sources of U. Nothing where S and Q are refused."""
    if result.calibration is None:
        return
    yield from aligned([("", "Sx", "Sy", "Sz", "Q"), *rows_of(result)])
    yield from notes_of(result)
    if sources := largest_sources(result):
        heads = [f"U({PARAMETERS[k]})" for k in parameters_of(result)]
        rows = [(s.name, *map(rounded, s.expanded), s.way) for s in sources]
        yield from aligned([("largest sources", *heads, "smaller with"), *rows], words=(0, len(heads) + 1))


def rows_of(result: MeasurementResult) -> list[tuple[str, ...]]:
    """A row for each axis: its name, and its parameters as value ± U."""
    cells = result.cells()
    return [(axis, *cells[3 * i : 3 * i + 3], cells[9 + i]) for i, axis in enumerate(AXES)]


def notes_of(result: MeasurementResult) -> Iterator[str]:
    """Units and k, what was known before, where S holds and what did not move, as sentences without full stop."""
    shown = shown_in(result.unit)
    kind = f", {result.uncertainty_kind}" if result.uncertainty_kind else ""
    yield f"{shown.words}, U with k = {result.coverage_factor:.3g}{kind}"
    if np.any(np.isfinite(result.values) & ~result.determined):
        yield f"{KNOWN_BEFORE} known before: the data do not halve its uncertainty"
    if result.where_it_holds:
        yield result.where_it_holds
    if result.where_nothing_moved:
        yield result.where_nothing_moved
    if at_rest := _at_0hz(result, shown.factors):
        yield f"at 0 Hz: {at_rest}"


def _at_0hz(result: MeasurementResult, factors: Array) -> str:
    """The main sensitivities at rest; "" where they are not known, or where S itself holds there."""
    told: Mapping[str, Any] | None = result.more.get("sensitivity_at_0hz")
    if told is None or not result.reference_frequency_hz:
        return ""
    names = ("sensitivity", "standard_uncertainty")
    S, u = (factors[:9] * np.asarray(told[name], dtype=float).ravel() for name in names)
    known = [k for k in MAIN if np.isfinite(S[k]) and np.isfinite(u[k])]
    return ", ".join(f"{PARAMETERS[k]} {plus_minus(S[k], result.coverage_factor * u[k])}" for k in known)


def parameters_of(result: MeasurementResult) -> list[int]:
    """The main sensitivity with the largest relative U, and the offset with the largest U, as far as they are known."""
    u, values = result.standard_uncertainty, result.values
    compared = {k: u[k] / abs(values[k]) for k in MAIN if values[k]} | {k: u[k] for k in OFFSET}
    told = [[k for k in group if np.isfinite(compared.get(k, np.nan))] for group in (MAIN, OFFSET)]
    return [max(group, key=lambda k: float(compared[k])) for group in told if group]


def largest_sources(result: MeasurementResult) -> list[UncertaintySource]:
    """The sources with the largest shares in the variances of `parameters_of`, the largest first; three at most."""
    chosen = parameters_of(result)
    variances = result.standard_uncertainty[chosen] ** 2
    factors = result.coverage_factor * shown_in(result.unit).factors[chosen]
    parts = {name: np.array([_of(part, k) for k in chosen]) for name, part in result.more.get("budget", {}).items()}
    shares = {name: float(np.max(u**2 / variances)) for name, u in parts.items() if u.size}
    largest = sorted(shares, key=lambda name: -shares[name])[:MOST_SOURCES]
    return [UncertaintySource(name, tuple((factors * parts[name]).tolist()), way_of(name)) for name in largest]


def way_of(source: str) -> str:
    """What makes a source of the uncertainty smaller."""
    stated = [kind.prior for kind in KINDS.values() if kind.source == source]
    stated += [s for s in BETWEEN_WINDOWS if source == "offset between windows" and s.name == "offset_mps2"]
    options = dict.fromkeys(f"`{STATED[s.name][0]}`" for s in stated if s is not None and s.name in STATED)
    return ", ".join(options) or _WAYS.get(source, "")


def _of(source: Mapping[str, float] | Array, k: int) -> float:
    return float(source[PARAMETERS[k]] if isinstance(source, Mapping) else source[k])
