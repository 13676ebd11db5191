"""The figure and the table of a result over frequency."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure, FigureBase
from matplotlib.ticker import LogLocator, NullFormatter

from agent.report.result import CalibrationResult
from agent.report.style import ABOVE, INK, PALE, figure, series
from calib.model import Array

MAIN = [0, 4, 8]


def response(result: CalibrationResult) -> Figure | None:
    """Main sensitivities over frequency, as a figure by itself; None where the result does not tell them."""
    if not has_response(result):
        return None
    drawn = figure(3.2)
    draw_response(drawn, result)
    return drawn


def has_response(result: CalibrationResult) -> bool:
    """Whether a main sensitivity is known in any band."""
    return bool(np.isfinite(over_frequency(result)[1]).any())


def draw_response(on: FigureBase, result: CalibrationResult) -> None:
    """By how many per cent the main sensitivities of each band differ from S, with U.

    The band where S alone is right is shaded, and the frequency at which S holds is dotted.
    """
    axes = on.subplots()
    middle, relative, U = over_frequency(result)
    if result.frequencies.valid_band_hz:
        axes.axvspan(*result.frequencies.valid_band_hz, color=PALE, linewidth=0)
    for k in range(3):
        shift = 1.0 + 0.02 * (k - 1)  # so that the bars of three axes can be told apart
        axes.errorbar(middle * shift, 100 * relative[:, k], 100 * U[:, k], **series(k))
    axes.axhline(0, color=INK, linewidth=0.6)
    if result.frequencies.reference_frequency_hz:
        axes.axvline(result.frequencies.reference_frequency_hz, color=INK, linewidth=0.8, linestyle=":")
    axes.set_xscale("log")
    axes.set(xlabel="frequency in Hz", ylabel="% of S")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.legend(ncols=3, **ABOVE)


def over_frequency(result: CalibrationResult) -> tuple[Array, Array, Array]:
    """Middles (B,) of the bands in Hz; deviation of |S_ii| from S_ii, and U, (B, 3), as shares; NaN: not known."""
    bands = result.frequencies.bands
    if not bands:
        return np.empty(0), np.empty((0, 3)), np.empty((0, 3))
    values = [
        np.array([np.diag(np.array(matrix, dtype=float)) for matrix in matrices])
        for matrices in zip(*((b.sensitivity_re, b.sensitivity_im, b.standard_uncertainty) for b in bands), strict=True)
    ]
    S, k = result.values[MAIN], result.coverage_factor[MAIN]
    edges = np.array([[band.low_hz, band.high_hz] for band in bands])
    size = np.hypot(values[0], values[1])
    return np.sqrt(edges.prod(axis=1)), size / np.abs(S) - 1.0, k * values[2] / np.abs(S)
