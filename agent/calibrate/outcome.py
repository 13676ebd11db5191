"""The outcome of `fieldcal calibrate`, as the JSON object of docs/calibrate.md and as text for people."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from agent import __version__
from agent.terminal.quantity import plus_minus
from calib.model import PARAMETERS, Array, Calibration, Window

AXES = "xyz"
FILE_WIDTH = 120  # columns if the output is no terminal
KNOWN_BEFORE = "*"  # marks a parameter that --nominal or --prior tells rather than the data


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


def print_outcome(outcome: Outcome) -> None:
    """Print the windows with their verdicts, and S and Q with their expanded uncertainties."""
    from agent.terminal.console import TextConsole

    console = TextConsole(width=None if sys.stdout.isatty() else FILE_WIDTH)
    _print_windows(console, outcome.windows)
    if outcome.calibration is not None:
        _print_calibration(console, outcome)
    for n in outcome.nuisances:
        console.print(f"  {n.name}: {plus_minus(n.value, outcome.coverage_factor * n.standard_uncertainty)} {n.unit}")
    console.print_line(f"  sampling rate {outcome.rate_hz:.7g} Hz")


def _print_calibration(console: Any, outcome: Outcome) -> None:
    from rich import box
    from rich.table import Table

    c = outcome.calibration
    assert c is not None
    expanded = outcome.coverage_factor * c.standard_uncertainty
    values = np.append(c.sensitivity.ravel(), c.offset)
    cells = [_cell(*each) for each in zip(values.tolist(), expanded.tolist(), c.determined.tolist(), strict=True)]
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("", "Sx", "Sy", "Sz", "Q"):
        table.add_column(heading, justify="right", no_wrap=True)
    for i, axis in enumerate(AXES):
        table.add_row(axis, *cells[3 * i : 3 * i + 3], cells[9 + i])
    console.print(table)
    kind = f", {outcome.uncertainty_kind}" if outcome.uncertainty_kind else ""
    console.print(f"  S in output unit per m/s², Q in output unit, U with k = {outcome.coverage_factor:.3g}{kind}")
    if np.any(np.isfinite(values) & ~c.determined):
        console.print_line(f"  {KNOWN_BEFORE} known before: the data do not halve its uncertainty")
    _print_sources(console, outcome)
    _print_frequencies(console, outcome)
    console.print_line(f"  method {outcome.method}, {sum(w.used for w in outcome.windows)} windows")


def _print_frequencies(console: Any, outcome: Outcome) -> None:
    if outcome.more.get("valid_band_hz"):
        low_hz, high_hz = outcome.more["valid_band_hz"]
        at_hz = outcome.more["reference_frequency_hz"]
        console.print_line(
            f"  S holds at {at_hz:.3g} Hz; from {low_hz:.3g} to {high_hz:.3g} Hz it is right within a third of U"
        )


def _print_sources(console: Any, outcome: Outcome) -> None:
    """Print the sources of the uncertainty of the main sensitivity with the largest u, and of such an offset.

    Sources below a tenth of that u are left out.
    """
    assert outcome.calibration is not None
    u = outcome.calibration.standard_uncertainty
    for group in ([0, 4, 8], [9, 10, 11]):
        told = [k for k in group if np.isfinite(u[k])]
        if not told or "budget" not in outcome.more:
            continue
        worst = max(told, key=lambda k: float(u[k]))
        parts = {name: _of(source, worst) for name, source in outcome.more["budget"].items()}
        large = sorted((name for name in parts if parts[name] > 0.1 * u[worst]), key=lambda name: -parts[name])
        sources = ", ".join(f"{name} {parts[name]:.2g}" for name in large)
        console.print_line(f"  u({PARAMETERS[worst]}) = {u[worst]:.2g}: {sources}")


def _of(source: Mapping[str, float] | Array, k: int) -> float:
    return float(source[PARAMETERS[k]] if isinstance(source, Mapping) else source[k])


def _cell(value: float, expanded: float, determined: bool) -> str:
    if not math.isfinite(value):
        return "not determined"
    text = "0" if value == expanded == 0.0 else plus_minus(value, expanded)  # 0 because the frame was chosen so
    return text if determined else f"{text} {KNOWN_BEFORE}"


def _print_windows(console: Any, windows: Sequence[Window]) -> None:
    for w in windows:
        left = f", {w.left_out} left out" if w.left_out else ""
        verdict = f"{w.points} points{left}" if w.used else f"not used: {w.reason}"
        console.print_line(f"  {w.start_s:10.3f} to {w.stop_s:10.3f} s  {w.pose.position}: {verdict}")
