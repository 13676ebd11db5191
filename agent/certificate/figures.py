"""The figures of a certificate: S with U, the response over frequency, and residuals or history."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from agent.certificate.content import MAIN, ResultCertificate
from agent.report import style
from agent.report.frequencies import draw_response, has_response
from agent.report.trace import by_phase
from agent.report.units import labelled, output_unit, sensitivity_unit
from agent.terminal.text import figure_text

AXES = "xyz"
Draw = Callable[[FigureBase, ResultCertificate], None]


def figures_of(c: ResultCertificate) -> list[tuple[str, float, Draw]]:
    """Caption, height in inches at the full width of a phone's screen, and the function that draws it."""
    drawn: list[tuple[str, float, Draw]] = [("Main sensitivities with their expanded uncertainties", 2.6, _main)]
    if has_response(c.result):
        drawn.append(("Main sensitivities over frequency, with their expanded uncertainties", 2.6, _response))
    if len(c.history) > 1:
        drawn.append(("Earlier calibrations: main sensitivities relative to the newest", 2.6, _history))
    if any(r.phase_rad is not None for r in c.seen):
        drawn.append(
            (
                "Residuals V - (S a + Q) of one window over the phase of the motion, with the poses as stated",
                2.6,
                _residuals,
            )
        )
    return drawn


def figure(c: ResultCertificate, height_in: float, draw: Draw) -> Figure:
    """One figure by itself."""
    drawn = style.figure(height_in)
    draw(drawn, c)
    return drawn


def _main(on: FigureBase, c: ResultCertificate) -> None:
    result = c.result.in_display_units
    subplots = on.subplots(3, 1)
    for k, axes in enumerate(subplots):
        value, U = result.values[MAIN[k]], result.expanded_uncertainty[MAIN[k]]
        if np.isfinite(value):
            error = U if np.isfinite(U) else None
            axes.errorbar(value, 0, xerr=error, fmt="o", color=style.AXIS_COLOURS[k], capsize=4)
        axes.set(yticks=[], ylim=(-1, 1))
        axes.set_ylabel(f"$S_{{{AXES[k]}{AXES[k]}}}$", rotation=0, ha="right", va="center")
        axes.margins(x=0.3)
        axes.locator_params(axis="x", nbins=5)
        axes.spines["left"].set_visible(False)
    subplots[-1].set_xlabel(labelled("S", figure_text(sensitivity_unit(result.unit))))


def _response(on: FigureBase, c: ResultCertificate) -> None:
    draw_response(on, c.result)


def _history(on: FigureBase, c: ResultCertificate) -> None:
    axes = on.subplots()
    days = np.array([update.date_utc_ns for update in c.history]) / 86_400e9
    S = np.array([np.diag(update.sensitivity) for update in c.history])
    U = np.array([update.coverage_factor * np.array(update.standard_uncertainty)[MAIN] for update in c.history])
    for k in range(3):
        axes.errorbar(days - days[-1], 100 * (S[:, k] / S[-1, k] - 1), 100 * U[:, k] / abs(S[-1, k]), **style.series(k))
    axes.set(xlabel="days before the newest", ylabel="%")
    axes.legend(ncols=3, **style.ABOVE)


def _residuals(on: FigureBase, c: ResultCertificate) -> None:
    axes: Axes = on.subplots()
    seen = next(r for r in reversed(c.seen) if r.phase_rad is not None)
    assert seen.phase_rad is not None
    middle, mean, error = by_phase(seen.phase_rad, seen.residual)
    for k in range(3):
        axes.errorbar(np.degrees(middle), mean[:, k], 2 * error[:, k], **style.series(k))
    axes.axhline(0, color=style.INK, linewidth=0.6)
    axes.set(xlabel="phase of the reference in degrees", ylabel=figure_text(output_unit(c.result.unit)), xlim=(0, 360))
    axes.legend(ncols=3, **style.ABOVE)
