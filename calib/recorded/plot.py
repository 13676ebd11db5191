"""A result as a figure. This module alone of `calib` needs matplotlib; Outcome.plot imports it."""

from __future__ import annotations

import io
import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calib.model import PARAMETERS, Array
from calib.recorded.measurement_result import MeasurementResult

AXES = "xyz"
COLOURS = ("#0068b5", "#c2500a", "#00805e")  # x, y, z; colour-blind people can distinguish them too
PALE = "#9aa2ad"
MAIN = np.eye(3, dtype=bool).ravel()
BESIDE = 1.015  # ratio of the frequencies at which two axes are drawn, so that their bars can be told apart
WRAP, MOST_REASONS = 95, 6  # letters of a line, lines


class Drawing(Figure):
    """A figure that a notebook shows once, with or without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png")
        return buffer.getvalue()


def figure_of(result: MeasurementResult) -> Drawing:
    """S and Q with U (or the reasons for a refusal), the response over frequency where it is known, and the windows."""
    bands = result.response
    figure = Drawing(figsize=(9.0, 5.4 if bands else 3.6), dpi=80, layout="constrained", facecolor="white")
    heights = [3.0, 3.0, 1.0] if bands else [3.0, 1.0]
    grid = figure.add_gridspec(len(heights), 2, height_ratios=heights, width_ratios=[3.0, 1.0])
    if result.calibration is None:
        _reasons(figure.add_subplot(grid[0, :]), result)
    else:
        _sensitivity(figure.add_subplot(grid[0, 0]), result)
        _offset(figure.add_subplot(grid[0, 1]), result)
    if bands:
        _response(figure.add_subplot(grid[1, :]), result)
    _windows(figure.add_subplot(grid[-1, :]), result)
    return figure


def _reasons(axes: Axes, result: MeasurementResult) -> None:
    lines = [line for reason in result.reasons for line in textwrap.wrap(reason, WRAP, subsequent_indent="  ")]
    if len(lines) > MOST_REASONS:
        lines = [*lines[: MOST_REASONS - 1], "..."]
    axes.set_axis_off()
    axes.set_title("refused", loc="left", fontweight="bold")
    axes.text(0.0, 0.95, "\n".join(lines), va="top", transform=axes.transAxes, parse_math=False)


def _sensitivity(axes: Axes, result: MeasurementResult) -> None:
    """Main sensitivities as deviations from their mean, transverse ones as they are, all in % of that mean."""
    values = result.values[:9]
    mean = float(np.nanmean(np.abs(values[MAIN])))
    shown = 100.0 * (np.where(MAIN, np.abs(values) - mean, values)) / mean
    _points(axes, shown, 100.0 * result.expanded_uncertainty[:9] / mean, PARAMETERS[:9])
    axes.set_title(f"S: main minus their mean {mean:.6g}, and transverse", loc="left", fontsize=10)
    axes.set_ylabel("% of the mean")


def _offset(axes: Axes, result: MeasurementResult) -> None:
    _points(axes, result.offset, result.expanded_uncertainty[9:], PARAMETERS[9:])
    axes.set_title("Q", loc="left", fontsize=10)
    axes.set_ylabel("output unit")


def _points(axes: Axes, values: Array, expanded: Array, names: tuple[str, ...]) -> None:
    """Values with ± U, in the colour of the output's axis."""
    for k, name in enumerate(names):
        colour = COLOURS[AXES.index(name[1])]
        if np.isfinite(values[k]):
            axes.errorbar(k, values[k], expanded[k], fmt="o", color=colour, capsize=4, markersize=4)
        else:
            axes.annotate("not\ndetermined", (k, 0.5), xycoords=("data", "axes fraction"), ha="center", fontsize=7)
    axes.axhline(0.0, color=PALE, linewidth=0.8)
    axes.set_xticks(range(len(names)), names)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.spines[["top", "right"]].set_visible(False)


def _response(axes: Axes, result: MeasurementResult) -> None:
    """Magnitude of the main sensitivities in each band, relative to that in the band of the reference frequency."""
    bands, at_hz = result.response, result.reference_frequency_hz or 0.0
    here = min(bands, key=lambda band: abs(np.sqrt(band.low_hz * band.high_hz) - at_hz))
    for i, axis in enumerate(AXES):
        there = np.array([abs(band.sensitivity[i, i]) for band in bands])
        u = np.array([band.standard_uncertainty[i, i] for band in bands])
        at, expanded = 100.0 * (there / abs(here.sensitivity[i, i]) - 1.0), 100.0 * result.coverage_factor * u / there
        beside = BESIDE ** (i - 1)
        middles = [beside * float(np.sqrt(band.low_hz * band.high_hz)) for band in bands]
        style: dict[str, Any] = {"color": COLOURS[i], "capsize": 3, "markersize": 3}
        axes.errorbar(middles, at, expanded, fmt="o-", label=f"S{2 * axis}", **style)
    axes.axvline(at_hz, color=PALE, linewidth=0.8, linestyle="--")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.set_title(f"response: main sensitivities ± U, relative to those at {at_hz:.3g} Hz", loc="left", fontsize=10)
    axes.set_ylabel("%")
    axes.set_xlabel("frequency / Hz")
    axes.legend(frameon=False, ncols=3, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)


def _windows(axes: Axes, result: MeasurementResult) -> None:
    """Windows over time: those that are used filled, the others empty."""
    for used, colour in ((True, COLOURS[0]), (False, "none")):
        spans = [(w.start_s, w.stop_s - w.start_s) for w in result.windows if w.used is used]
        axes.broken_barh(spans, (0.1, 0.8), facecolor=colour, edgecolor=COLOURS[0])
    count = sum(w.used for w in result.windows)
    title = f"windows: {count} used (filled), {len(result.windows) - count} not used (empty)"
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_yticks([])
    axes.set_ylim(0.0, 1.0)
    axes.autoscale_view(scaley=False)
    axes.set_xlabel("time / s")
    axes.spines[["top", "right", "left"]].set_visible(False)
