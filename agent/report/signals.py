"""Figures of one window point by point: indications against S a + Q, and residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from agent.report.style import AXIS_COLOURS, INK, figure
from agent.report.trace import Residuals, by_phase, spans, spectrum
from agent.report.units import output_unit
from agent.terminal.text import figure_text
from calib.model import Array

AXES = "xyz"
CYCLES_SHOWN = 4.0  # of the mean frequency of the motion; more cannot be distinguished in the figure
REST_SHOWN_S = 2.0
COLUMNS = 300  # intervals of time that a plot of this width can show


def indications(seen: Residuals, unit: str) -> Figure:
    """V as points and S a + Q as a line over some cycles in the middle of the window (Figure 2)."""
    length_s = CYCLES_SHOWN / seen.frequency_hz if seen.frequency_hz else REST_SHOWN_S
    middle = 0.5 * (seen.time_s[0] + seen.time_s[-1])
    shown = np.abs(seen.time_s - middle) <= length_s / 2
    drawn = figure(5.6)
    subplots = drawn.subplots(3, 1, sharex=True)
    time_s = seen.time_s[shown]
    for k, axes in enumerate(subplots):
        axes.plot(time_s, seen.indications[shown, k], ".", markersize=2.5, color=AXIS_COLOURS[k])
        axes.plot(time_s, seen.model[shown, k], color=INK, linewidth=0.8)
        axes.set_title(f"$V_{AXES[k]}$" + (", mean taken off" if seen.centred else ""))
        axes.locator_params(axis="y", nbins=5)
    drawn.supylabel(f"indication in {figure_text(output_unit(unit))}", fontsize=10)
    subplots[-1].set_xlabel("time in s")
    return drawn


def left_over(seen: Residuals, unit: str) -> Figure:
    """V - (S a + Q): over time with a strip for each axis, over the phase of the motion, and as a spectrum."""
    ways = [_over_phase, _spectrum] if seen.phase_rad is not None else [_spectrum]
    drawn = figure(3.3 + 2.0 * len(ways))
    heights = [0.9] * 3 + [2.0] * len(ways)
    subplots = drawn.subplots(len(heights), 1, gridspec_kw={"height_ratios": heights})
    _over_time(subplots[:3], seen, figure_text(output_unit(unit)))
    for axes, way in zip(subplots[3:], ways, strict=True):
        way(axes, seen, figure_text(output_unit(unit)))
    handles = [Patch(color=colour, label=axis) for axis, colour in zip(AXES, AXIS_COLOURS, strict=True)]
    drawn.legend(handles=handles, loc="outside upper center", ncols=3)
    return drawn


def _over_time(strips: Sequence[Axes], seen: Residuals, unit: str) -> None:
    middle, low, high = spans(seen.time_s, seen.residual, COLUMNS)
    for k, axes in enumerate(strips):
        axes.fill_between(middle, low[:, k], high[:, k], color=AXIS_COLOURS[k], linewidth=0)
        axes.locator_params(axis="y", nbins=3)
        axes.tick_params(labelbottom=k == 2)
    strips[0].set_title("over time: smallest to largest")
    strips[1].set_ylabel(unit)
    strips[2].set_xlabel("time in s")


def _over_phase(axes: Axes, seen: Residuals, unit: str) -> None:
    assert seen.phase_rad is not None
    middle, mean, error = by_phase(seen.phase_rad, seen.residual)
    for k in range(3):
        _with_band(axes, np.degrees(middle), mean[:, k], 2 * error[:, k], AXIS_COLOURS[k])
    axes.axhline(0, color=INK, linewidth=0.6)
    axes.set(title="over phase: mean with twice its standard error", ylabel=unit, xlim=(0, 360))
    axes.set_xlabel("phase of the reference in degrees, 0 at its maximum")
    axes.set_xticks(range(0, 361, 60))


def _with_band(axes: Axes, x: Array, y: Array, half: Array, colour: str) -> None:
    axes.plot(x, y, color=colour)
    axes.fill_between(x, y - half, y + half, color=colour, alpha=0.3, linewidth=0)


def _spectrum(axes: Axes, seen: Residuals, unit: str) -> None:
    frequency_hz, density = spectrum(seen.residual, seen.rate_hz)
    for k in range(3):
        axes.loglog(frequency_hz, density[:, k], color=AXIS_COLOURS[k], linewidth=0.8)
    known = density[density > 0]
    if known.size:  # limits are whole decades, so that at least their ends have numbers
        axes.set_ylim(10 ** np.floor(np.log10(np.quantile(known, 0.001))), 10 ** np.ceil(np.log10(known.max())))
    if seen.frequency_hz:
        axes.axvline(seen.frequency_hz, color=INK, linewidth=0.8, linestyle=":")
    axes.set(title="spectrum", xlabel="frequency in Hz", ylabel=f"{unit}/√Hz")
