"""The outcome of `fieldcal calibrate` as text for people."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from agent.calibrate.faults import with_dashes
from agent.terminal.text import one_line, say
from calib.model import Window
from calib.recorded.measurement_result import NuisanceValue
from calib.recorded.outcome import Outcome
from calib.recorded.table import FIRST_DATE_S, moment
from calib.recorded.told import lines_of


def print_outcome(outcome: Outcome, *, everything: bool = False) -> None:
    """Print the windows with their verdicts, the warnings, and S and Q with their expanded uncertainties.

    `everything`: also the nuisances and the sampling rate.
    """
    _print_windows(outcome.windows)
    if everything:
        _print_nuisances(outcome.nuisances, outcome.coverage_factor)
        say(f"  sampling rate {outcome.rate_hz:.7g} Hz")
    say(f"  method {outcome.method}, {sum(w.used for w in outcome.windows)} windows")
    if outcome.more.get("joint"):
        say("  the JSON result keeps what is known of sums of elements of S: state it next as --prior")
    print_warnings(outcome.warnings)
    for line in lines_of(outcome):
        say(f"  {with_dashes(line)}")


def print_warnings(warnings: Sequence[str], *, err: bool = False) -> None:
    """Print each warning as one line that cannot be overlooked: on standard output, or on standard error."""
    if not warnings:
        return
    from agent.terminal.console import TextConsole

    console = TextConsole(sys.stderr if err else sys.stdout)
    for warning in warnings:
        console.print(one_line(f"WARNING: {warning}"), style="bold red", soft_wrap=True)


def _print_nuisances(nuisances: Sequence[NuisanceValue], coverage_factor: float) -> None:
    for n in nuisances:
        say(f"  {n.name}: {n.cell(coverage_factor)}")


def _print_windows(windows: Sequence[Window]) -> None:
    for w in windows:
        left = f", {w.left_out} left out" if w.left_out else ""
        verdict = f"{w.points} points{left}" if w.used else f"not used: {w.reason}"
        say(f"  {_span(w)}  {w.pose.position}: {verdict}")


def _span(w: Window) -> str:
    """From when to when: in s, or as dates where the times count since 1970."""
    if w.start_s < FIRST_DATE_S:
        return f"{w.start_s:10.3f} to {w.stop_s:10.3f} s"
    return f"{moment(w.start_s)} to {moment(w.stop_s)}"
