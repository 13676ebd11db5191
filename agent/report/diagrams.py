"""Figures of S: its rows in space (Figures 6 to 9, 13 to 15), and its elements with U (Figures 10 to 12)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from agent.report.result import CalibrationResult
from agent.report.style import AXIS_COLOURS, INK, RESULT_COLOURS, RESULT_MARKERS, WIDTH_IN, bare, figure
from agent.report.units import labelled, sensitivity_unit
from agent.terminal.text import figure_text
from calib.model import PARAMETERS, Array

AXES = "xyz"
TRANSVERSE = [(i, j) for i in range(3) for j in range(3) if i != j]


def rows_in_space(result: CalibrationResult) -> Figure | None:
    """Each row of S as a point, as Figure 6 defines it; its axis is the locus of a sensor without transverse ones.

    A row whose transverse sensitivities are not known (Figure 8) is a hollow point on its axis. None where no main
    sensitivity is known.
    """
    S = np.where(np.eye(3, dtype=bool), result.sensitivity, np.nan_to_num(result.sensitivity))
    known = [i for i in range(3) if np.isfinite(S[i, i])]
    if not known:
        return None
    drawn = Figure(figsize=(WIDTH_IN, 4.6))  # placed by numbers: an automatic layout makes a diagram in space too small
    axes: Any = drawn.add_axes((0.0, 0.16, 1.0, 0.84), projection="3d")
    reach = 1.15 * float(np.abs(S[known]).max())
    low = min(0.0, 1.15 * float(S[known].min()))
    _frame(axes, low, reach)
    for i in known:
        ideal = np.zeros(3)
        ideal[i] = S[i, i]
        axes.plot(*np.stack([np.zeros(3), S[i]]).T, color=AXIS_COLOURS[i], linewidth=1.6)
        axes.plot(*np.stack([ideal, S[i]]).T, color=AXIS_COLOURS[i], linewidth=1, linestyle=":")
        name = f"({', '.join(f'$S_{{{AXES[i]}{axis}}}$' for axis in AXES)})"
        fill = "full" if np.isfinite(result.sensitivity[i]).all() else "none"
        label = f"{name} = {_row(result.sensitivity[i])}"
        axes.plot(*S[i][:, None], "o", color=AXIS_COLOURS[i], markersize=6, fillstyle=fill, label=label)
    for line in axes.lines:
        line.set_clip_on(False)
    drawn.legend(loc="lower center", ncols=1, title=labelled("Rows of S", figure_text(sensitivity_unit(result.unit))))
    return drawn


def _frame(axes: Any, low: float, reach: float) -> None:
    """Draw three axes through the origin, each with its numbers."""
    axes.set_axis_off()
    axes.set(xlim=(low, reach), ylim=(low, reach), zlim=(low, reach))
    axes.view_init(elev=22, azim=38)
    axes.set_box_aspect(None, zoom=1.15)
    ticks = [t for t in MaxNLocator(4).tick_values(low, reach) if 0.95 * low < t < 0.95 * reach and t != 0]
    beside = -reach * np.array([[0, 0, 0.07], [0, 0, 0.07], [0, 0.13, 0]])  # position of the numbers of each axis
    for j, axis in enumerate(AXES):
        ends = np.outer((low, reach), np.eye(3)[j])
        axes.plot(*ends.T, color=INK, linewidth=0.8)
        axes.text(*(1.07 * ends[1]), axis, ha="center", va="center", fontweight="bold")
        for tick in ticks:
            axes.plot(*(tick * np.eye(3)[j])[:, None], "|" if j < 2 else "_", color=INK, markersize=6)
            axes.text(*(tick * np.eye(3)[j] + beside[j]), f"{tick:g}", fontsize=8, ha="center", va="center")


def main_sensitivities(results: Sequence[CalibrationResult]) -> Figure | None:
    """S_xx, S_yy, S_zz of each result with U; None if there is none."""
    names = [f"$S_{{{axis}{axis}}}$" for axis in AXES]
    places = [PARAMETERS.index(f"S{axis}{axis}") for axis in AXES]
    values = [(r.values[places], r.expanded_uncertainty[places]) for r in results]
    if not any(np.isfinite(v).any() for v, _ in values):
        return None
    unit = sensitivity_unit(results[0].unit)
    drawn = figure(1.2 + 3 * (0.55 + 0.26 * len(results)))
    for axes, name, k in zip(np.atleast_1d(drawn.subplots(3, 1)), names, range(3), strict=True):
        for row, (value, expanded) in enumerate(values):
            if np.isfinite(value[k]):
                _bar(axes, row, value[k], expanded[k], row)
        if not any(np.isfinite(value[k]) for value, _ in values):
            axes.set_xticks([])
        axes.set(
            yticks=range(len(results)),
            yticklabels=[figure_text(r.label) for r in results],
            title=labelled(name, figure_text(unit)),
        )
        axes.set_ylim(len(results) - 0.4, -0.6)
        axes.margins(x=0.15)
        axes.locator_params(axis="x", nbins=5)
        bare(axes)
    return drawn


def transverse_sensitivities(results: Sequence[CalibrationResult]) -> Figure | None:
    """The six transverse sensitivities in % of the main one of their row (rel_S, Appendix A), with U."""
    values = [_relative(r) for r in results]
    if not any(np.isfinite(v).any() for v, _ in values):
        return None
    drawn = figure(1.4 + 0.3 * 6 * max(1.0, 0.5 * len(results)))
    axes = drawn.subplots()
    step = 0.7 / len(results)
    for k, (result, (value, expanded)) in enumerate(zip(results, values, strict=True)):
        if not np.isfinite(value).any():
            continue
        shift = (k - 0.5 * (len(results) - 1)) * step
        for row in range(6):
            _bar(axes, row + shift, value[row], expanded[row], k, figure_text(result.label) if row == 0 else None)
    axes.axvline(0, color=INK, linewidth=0.8)
    axes.set(yticks=range(6), yticklabels=[f"$S_{{{AXES[i]}{AXES[j]}}}$" for i, j in TRANSVERSE])
    axes.set_xlabel("% of the main sensitivity of the row")
    axes.set_ylim(5.6, -0.6)
    bare(axes)
    if len(results) > 1:
        drawn.legend(loc="outside lower center", ncols=2)
    return drawn


def _bar(axes: Axes, row: float, value: float, expanded: float, k: int, label: str | None = None) -> None:
    """A value with its expanded uncertainty, or without if the uncertainty is not known."""
    axes.errorbar(
        value, row, xerr=expanded if np.isfinite(expanded) else None, label=label, capsize=4, markersize=6,
        fmt=RESULT_MARKERS[k % len(RESULT_MARKERS)], color=RESULT_COLOURS[k % len(RESULT_COLOURS)],
    )  # fmt: skip


def _relative(result: CalibrationResult) -> tuple[Array, Array]:
    """(6,) transverse sensitivities and their U in % of the main one of their row."""
    S, U = result.sensitivity, result.expanded_uncertainty[:9].reshape(3, 3)
    pick = tuple(np.array(TRANSVERSE).T)
    main = np.abs(np.diag(S))[pick[0]]
    return 100 * S[pick] / main, 100 * U[pick] / main


def _row(values: Array) -> str:
    """Numbers, all with the decimals that give the largest four digits; – for a number that is not known."""
    largest = float(np.nanmax(np.abs(values)))
    digits = max(0, 3 - int(np.floor(np.log10(largest)))) if largest > 0 else 3
    texts = [f"{v:.{digits}f}".replace("-", "−") if np.isfinite(v) else "–" for v in values]
    return f"({', '.join(texts)})"
