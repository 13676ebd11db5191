"""The figures of a certificate: S with U, the response over frequency, and residuals or history."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from agent.certificate.content import MAIN, Certificate
from agent.report import style
from agent.report.trace import by_phase
from agent.report.units import labelled, output_unit, sensitivity_unit
from agent.terminal.text import figure_text
from calib.model import Array

AXES = "xyz"
_ABOVE: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.0}
Draw = Callable[[FigureBase, Certificate], None]


def figures_of(c: Certificate) -> list[tuple[str, float, Draw]]:
    """Caption, height in inches at the full width of a phone's screen, and the function that draws it."""
    drawn: list[tuple[str, float, Draw]] = [("Main sensitivities with their expanded uncertainties", 2.6, _main)]
    if _has_response(c):
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


def figure(c: Certificate, height_in: float, draw: Draw) -> Figure:
    """One figure by itself."""
    drawn = style.figure(height_in)
    draw(drawn, c)
    return drawn


def _main(on: FigureBase, c: Certificate) -> None:
    result = c.result
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


def _response(on: FigureBase, c: Certificate) -> None:
    axes = on.subplots()
    middle, relative, U = _bands(c)
    for k in range(3):
        shift = 1.0 + 0.02 * (k - 1)  # so that the bars of three axes can be told apart
        axes.errorbar(middle * shift, 100 * relative[:, k], 100 * U[:, k], **_series(k))
    axes.axhline(0, color=style.INK, linewidth=0.6)
    at = c.told.reference_frequency_hz
    if at:
        axes.axvline(at, color=style.INK, linewidth=0.8, linestyle=":")
    axes.set_xscale("log")
    axes.set(xlabel="frequency in Hz", ylabel="% of S")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.tick_params(axis="x", which="minor", labelsize=7)
    axes.legend(ncols=3, **_ABOVE)


def _has_response(c: Certificate) -> bool:
    return bool(np.isfinite(_bands(c)[1]).any())


def _bands(c: Certificate) -> tuple[Array, Array, Array]:
    """Middles (B,) of the bands in Hz; deviation of |S_ii| from S_ii, and U, (B, 3), as shares; NaN: not known."""
    bands = c.told.bands
    if not bands:
        return np.empty(0), np.empty((0, 3)), np.empty((0, 3))
    values = [
        np.array([np.diag(np.array(matrix, dtype=float)) for matrix in matrices])
        for matrices in zip(*((b.sensitivity_re, b.sensitivity_im, b.standard_uncertainty) for b in bands), strict=True)
    ]
    S, k = c.result.values[MAIN], c.result.coverage_factor[MAIN]
    edges = np.array([[band.low_hz, band.high_hz] for band in bands])
    size = np.hypot(values[0], values[1])
    return np.sqrt(edges.prod(axis=1)), size / np.abs(S) - 1.0, k * values[2] / np.abs(S)


def _history(on: FigureBase, c: Certificate) -> None:
    axes = on.subplots()
    days = np.array([update.date_utc_ns for update in c.history]) / 86_400e9
    S = np.array([np.diag(update.sensitivity) for update in c.history])
    U = np.array([update.coverage_factor * np.array(update.standard_uncertainty)[MAIN] for update in c.history])
    for k in range(3):
        axes.errorbar(days - days[-1], 100 * (S[:, k] / S[-1, k] - 1), 100 * U[:, k] / abs(S[-1, k]), **_series(k))
    axes.set(xlabel="days before the newest", ylabel="%")
    axes.legend(ncols=3, **_ABOVE)


def _residuals(on: FigureBase, c: Certificate) -> None:
    axes: Axes = on.subplots()
    seen = next(r for r in reversed(c.seen) if r.phase_rad is not None)
    assert seen.phase_rad is not None
    middle, mean, error = by_phase(seen.phase_rad, seen.residual)
    for k in range(3):
        axes.errorbar(np.degrees(middle), mean[:, k], 2 * error[:, k], **_series(k))
    axes.axhline(0, color=style.INK, linewidth=0.6)
    axes.set(xlabel="phase of the reference in degrees", ylabel=figure_text(output_unit(c.result.unit)), xlim=(0, 360))
    axes.legend(ncols=3, **_ABOVE)


def _series(k: int) -> dict[str, Any]:
    """Style of an axis of the sensor; its marker tells it apart without colours too."""
    return {"color": style.AXIS_COLOURS[k], "marker": "osD"[k], "markersize": 4, "capsize": 3, "label": AXES[k]}
