"""The outcome of `fieldcal calibrate` as text for people."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.model import PARAMETERS, Array, Window
from calib.recorded.outcome import Outcome
from calib.rounding import KNOWN_BEFORE

AXES = "xyz"
FILE_WIDTH = 120  # columns if the output is no terminal


def print_outcome(outcome: Outcome) -> None:
    """Print the windows with their verdicts, and S and Q with their expanded uncertainties."""
    from agent.terminal.console import TextConsole

    console = TextConsole(width=None if sys.stdout.isatty() else FILE_WIDTH)
    _print_windows(console, outcome.windows)
    if outcome.calibration is not None:
        _print_calibration(console, outcome)
    for n in outcome.nuisances:
        console.print(f"  {n.name}: {n.cell(outcome.coverage_factor)}")
    console.print_line(f"  sampling rate {outcome.rate_hz:.7g} Hz")


def _print_calibration(console: Any, outcome: Outcome) -> None:
    from rich import box
    from rich.table import Table

    cells = outcome.cells()
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("", "Sx", "Sy", "Sz", "Q"):
        table.add_column(heading, justify="right", no_wrap=True)
    for i, axis in enumerate(AXES):
        table.add_row(axis, *cells[3 * i : 3 * i + 3], cells[9 + i])
    console.print(table)
    kind = f", {outcome.uncertainty_kind}" if outcome.uncertainty_kind else ""
    console.print(f"  S in output unit per m/s², Q in output unit, U with k = {outcome.coverage_factor:.3g}{kind}")
    if np.any(np.isfinite(outcome.values) & ~outcome.determined):
        console.print_line(f"  {KNOWN_BEFORE} known before: the data do not halve its uncertainty")
    _print_sources(console, outcome)
    if outcome.where_it_holds:
        console.print_line(f"  {outcome.where_it_holds}")
    console.print_line(f"  method {outcome.method}, {sum(w.used for w in outcome.windows)} windows")


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


def _print_windows(console: Any, windows: Sequence[Window]) -> None:
    for w in windows:
        left = f", {w.left_out} left out" if w.left_out else ""
        verdict = f"{w.points} points{left}" if w.used else f"not used: {w.reason}"
        console.print_line(f"  {w.start_s:10.3f} to {w.stop_s:10.3f} s  {w.pose.position}: {verdict}")
