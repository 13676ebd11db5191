"""Figures over time and over sources: windows with their verdicts, the history of S and Q, the uncertainty budget."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from agent.core.events import CalibrationUpdate
from agent.report.result import CalibrationResult, WindowVerdict
from agent.report.style import HELD, INK, PALE, REFUSED, SHADES, USED, bare, figure, series
from agent.report.units import offset_unit, position_name
from agent.terminal.text import figure_text
from calib.model import PARAMETERS
from calib.output_unit import shown_in

LANES = 16  # a figure has room for so many positions; if there are more, windows are arranged by verdict
MAIN = [0, 4, 8]
SOURCES = 7  # so many of the largest sources are named; the others are added up
COLOURS = {"used": USED, "held": HELD, "refused": REFUSED, "calm": PALE}  # by verdict


def windows(verdicts: Sequence[WindowVerdict]) -> Figure | None:
    """The windows over time, one lane for each position, coloured by verdict; None without windows."""
    if not verdicts:
        return None
    names = list(dict.fromkeys(w.position for w in verdicts))
    by_position = all(names) and len(names) <= LANES
    lanes = names if by_position else ["used", "not used"]
    drawn = figure(1.3 + 0.27 * len(lanes))
    axes = drawn.subplots()
    for w in verdicts:
        lane = lanes.index(w.position) if by_position else int(not w.used)
        colour = COLOURS[w.verdict]
        axes.barh(lane, w.stop_s - w.start_s, left=w.start_s, height=0.6, color=colour, edgecolor=INK, linewidth=0.5)
    labels = [figure_text(_short(position_name(name))) for name in lanes]
    axes.set(yticks=range(len(lanes)), yticklabels=labels, xlabel="time in s")
    axes.set_ylim(len(lanes) - 0.4, -0.6)
    axes.set_ylabel("position" if by_position else "")
    axes.margins(x=0.02)
    bare(axes)
    present = {w.verdict for w in verdicts}
    handles = [Patch(facecolor=c, edgecolor=INK, linewidth=0.5, label=n) for n, c in COLOURS.items() if n in present]
    drawn.legend(handles=handles, loc="outside upper right", ncols=4)
    return drawn


def _short(name: str) -> str:
    return name if len(name) <= 24 else f"{name[:22]}…"


def history(updates: Sequence[CalibrationUpdate], unit: str) -> Figure | None:
    """Main sensitivities (difference from the newest in %) and offsets over time, with U; None with fewer than two."""
    if len(updates) < 2:
        return None
    when = [dt.datetime.fromtimestamp(u.date_utc_ns / 1e9, dt.UTC) for u in updates]
    S = np.array([np.diag(u.sensitivity) for u in updates])
    factor = shown_in(unit).factors[9]
    Q = factor * np.array([u.offset for u in updates])
    U = np.array([u.coverage_factor * np.array(u.standard_uncertainty) for u in updates])
    drawn = figure(5.0)
    upper, lower = drawn.subplots(2, 1, sharex=True)
    for k in range(3):
        upper.errorbar(when, 100 * (S[:, k] / S[-1, k] - 1), 100 * U[:, MAIN[k]] / abs(S[-1, k]), **series(k))
        lower.errorbar(when, Q[:, k], factor * U[:, 9 + k], **series(k))
    upper.set(title="main sensitivities", ylabel="% difference from the newest")
    lower.set(title="offsets", ylabel=f"Q in {figure_text(offset_unit(unit))}", xlabel="UTC")
    handles, labels = upper.get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside upper right", ncols=3)
    return drawn


def budget(result: CalibrationResult) -> Figure | None:
    """Share of each source in the variance of each parameter; None if the result has no budget."""
    names, shares = variance_shares(result)
    if not names:
        return None
    drawn = figure(5.2)
    axes = drawn.subplots()
    left = np.zeros(12)
    for k, name in enumerate(names):
        axes.barh(
            range(12),
            np.where(result.determined, shares[k], 0.0),
            left=left,
            height=0.7,
            color=SHADES[k % len(SHADES)],
            label=figure_text(name),
        )
        left += np.nan_to_num(shares[k])
    labels = [f"${p[0]}_{{{p[1:]}}}$" for p in PARAMETERS]
    axes.set(yticks=range(12), yticklabels=labels, xlim=(0, 100), xlabel="% of the variance")
    axes.set_ylim(11.6, -0.6)
    bare(axes)
    drawn.legend(loc="outside lower center", ncols=2)
    return drawn


def variance_shares(result: CalibrationResult) -> tuple[list[str], np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    """Names of the largest sources, and the share (K, 12) in % that each has in the variance of each parameter."""
    if not result.budget or not result.determined.any():
        return [], np.empty((0, 12))
    all_names = list(result.budget)
    variances = np.array([result.budget[name] for name in all_names]) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = 100 * variances / variances.sum(axis=0)
    order = np.argsort(-np.nan_to_num(shares).sum(axis=1), kind="stable")
    named, rest = order[:SOURCES], order[SOURCES:]
    if len(rest) == 0:
        return [all_names[k] for k in named], shares[named]
    return [*(all_names[k] for k in named), "all others"], np.vstack([shares[named], shares[rest].sum(axis=0)])
