"""Figures 2 and 7-18 of the paper, from the virtual bench, and two more: s_rel and the uncertainty budgets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from calib.model import Array
from calib.paper.amplitudes import SineRun
from paper_reproduced.bench import Device
from paper_reproduced.comparison import MAIN, METHODS, Comparison
from paper_reproduced.published import REPEATABILITY_PCT, corrected_pct

# Colours of Okabe and Ito: distinct for colour-blind readers and in grey.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#555555"
COLOUR = {1: BLUE, 2: ORANGE, 3: GREEN}
AXIS_COLOUR = dict(zip("xyz", (BLUE, ORANGE, GREEN), strict=True))
MARKER = {1: "o", 2: "s", 3: "D"}
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.hashsalt": "fieldcal",  # fixed, so that the same figure gives the same file
    "path.simplify": True,
}
MAGNIFIED = 10  # factor of the transverse parts in the 3-D diagrams
OBLIQUE = np.array([[-0.72, -0.40], [0.88, -0.28], [0.0, 1.0]])  # x, y, z on paper
LABEL = {"x": (-0.95, -0.05), "y": (0.95, 0.12), "z": (0.62, 0.95)}


def save(figure: Figure, path: Path) -> None:
    """Write the figure in the format of the suffix of `path`; an SVG has the same bytes every time."""
    with mpl.rc_context(STYLE):
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None, dpi=110)


def figure_2(run: SineRun, a_ref_mps2: Array, unit: str) -> Figure:
    """Outputs and reference inputs over one period, Eqs. (9)-(11)."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.6), layout="constrained")
        axes = figure.add_subplot()
        t = run.time_s - run.time_s[0]
        inputs = a_ref_mps2[:, None] * run.pose.direction[:, 0] + run.pose.gravity_mps2
        for i, axis in enumerate("xyz"):
            axes.plot(t, run.indications[:, i], color=AXIS_COLOUR[axis], lw=0.9, label=f"$V_{axis}$")
            axes.plot(t, inputs[:, i], color=AXIS_COLOUR[axis], lw=1.8, ls=(0, (4, 3)), label=f"$a_{axis}$")
        axes.set(xlabel="time / s", ylabel=f"output $V$ / ({unit}), reference $a$ / (m/s²)", xlim=(0, t[-1]))
        axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def rows_of_s(device: Device, at: Mapping[int, Comparison]) -> Figure:
    """Rows of S as points in space (notation of Figure 6): one column per method, 3 Hz above 6 Hz."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.4, 5.6), layout="constrained")
        panels = figure.subplots(2, 3)
        for row, (frequency, found) in zip(panels, sorted(at.items()), strict=True):
            for axes, method in zip(row, METHODS, strict=True):
                axes.set_title(f"Method {method}, {frequency} Hz", weight="bold")
                _diagram(axes, device.nominal, found.sensitivity[method])
        figure.supxlabel(
            f"points: rows of $S$ in {per_mps2(device)}; transverse parts drawn {MAGNIFIED} times larger; "
            "hollow: transverse parts not seen",
            fontsize=9,
        )
    return figure


def _diagram(axes: Any, nominal: float, S: Array) -> None:
    axes.set_axis_off()
    axes.set_aspect("equal")
    for i, axis in enumerate("xyz"):
        colour = AXIS_COLOUR[axis]
        unit = np.eye(3)[i]
        tip = unit @ OBLIQUE
        axes.annotate("", 1.28 * tip, (0, 0), arrowprops={"arrowstyle": "-|>", "color": GREY, "lw": 0.7, "shrinkA": 0})
        axes.text(*(1.37 * tip), axis, color=GREY, ha="center", va="center")
        seen = np.isfinite(S[i]).all()
        row = np.where(unit > 0, S[i], MAGNIFIED * S[i] if seen else 0.0) / nominal
        # dotted: from the ideal point to the row's point, along the other two axes
        steps = [row[i] * unit, *(np.diag(row)[j] for j in range(3) if j != i)]
        corners = np.cumsum(steps, axis=0) @ OBLIQUE
        axes.plot(*corners.T, color=colour, lw=1.0, ls=":")
        axes.plot(*np.array([[0, 0], row @ OBLIQUE]).T, color=colour, lw=1.8, zorder=3)
        axes.plot(*(row @ OBLIQUE), marker="o", ms=6, mfc=colour if seen else "white", mec=colour, mew=1.5, zorder=4)
        axes.text(*LABEL[axis], f"$S_{{{axis}{axis}}}$ {S[i, i]:.4g}", color=colour, ha="center", va="center")
    axes.set(xlim=(-1.35, 1.45), ylim=(-0.85, 1.5))


def bars(device: Device, at: Mapping[int, Comparison]) -> Figure:
    """Main sensitivities by method with U (k = 2), and Methods 2 and 3 as they follow from the paper's differences."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.4, 3.6), layout="constrained")
        panels = figure.subplots(1, 3, sharey=False)
        for i, (axes, axis) in enumerate(zip(panels, "xyz", strict=True)):
            for k, (frequency, found) in enumerate(sorted(at.items())):
                _bar_group(axes, found, frequency, i, 4 * k)
            axes.set_xticks([1, 2, 3, 5, 6, 7], ["1", "2", "3"] * 2)
            for k, frequency in enumerate(sorted(at)):
                top = axes.get_xaxis_transform()
                axes.text(2 + 4 * k, 1.0, f"{frequency} Hz", transform=top, ha="center", va="bottom")
            centre = float(np.mean([found.main[1][i] for found in at.values()]))
            axes.set(xlabel="method", xlim=(0.3, 7.9), ylim=(0.91 * centre, 1.09 * centre))
            axes.set_ylabel(f"$S_{{{axis}{axis}}}$ in {per_mps2(device)}")
            axes.grid(visible=False, axis="x")
        handles, labels = panels[0].get_legend_handles_labels()
        unique = dict(zip(labels, handles, strict=True))
        figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=2)
    return figure


def _bar_group(axes: Any, found: Comparison, frequency: int, i: int, shift: int) -> None:
    for method in METHODS:
        value = found.main[method][i]
        U = 2 * float(np.sqrt(np.diag(found.statements[method].covariance)[MAIN[i]]))
        axes.errorbar(
            shift + method, value, U, color=COLOUR[method], marker=MARKER[method], ms=5, lw=1.4, capsize=3,
            label=f"Method {method}, virtual bench, U (k = 2)",
        )  # fmt: skip
        if method > 1:
            d = corrected_pct(found.device.key, frequency, (method, 1))[i] / 200
            there = found.main[1][i] * (1 + d) / (1 - d)
            axes.plot(shift + method + 0.4, there, marker="x", color="black", ms=6, mew=1.4, ls="none",
                      label="paper: its d_rel on the bench's Method 1")  # fmt: skip


def repeatability(found: Sequence[Comparison]) -> Figure:
    """s_rel of the main sensitivities over amplitude, with the paper's bounds."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        devices = list(dict.fromkeys(c.device.key for c in found))
        panels = figure.subplots(1, len(devices), sharey=True)
        for axes, key in zip(panels, devices, strict=True):
            of_device = [c for c in found if c.device.key == key]
            for method in METHODS:
                for frequency, face in ((3, COLOUR[method]), (6, "white")):
                    part = [c for c in of_device if round(c.frequency_hz) == frequency]
                    x = [c.amplitude_mps2 for c in part]
                    worst = [c.s_rel_pct[method].max() for c in part]
                    axes.plot(x, worst, color=COLOUR[method], marker=MARKER[method], mfc=face, lw=1, ms=5,
                              label=f"Method {method}, {frequency} Hz")  # fmt: skip
                axes.axhline(REPEATABILITY_PCT[key][method], color=COLOUR[method], lw=0.8, ls=":")
            axes.set(title=of_device[0].device.name, xlabel="amplitude / (m/s²)", xscale="log", yscale="log")
            axes.set_xticks([2, 5, 10, 20], ["2", "5", "10", "20"])
            axes.minorticks_off()
            axes.set_yticks([0.01, 0.03, 0.1, 0.3], ["0.01", "0.03", "0.1", "0.3"])
        panels[0].set_ylabel("largest $s_{rel}$ of $S_{xx}, S_{yy}, S_{zz}$ / %")
        panels[0].plot([], [], color=GREY, lw=0.8, ls=":", label="bound in the paper")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def budgets(found: Mapping[str, Comparison]) -> Figure:
    """Standard uncertainty of the main sensitivities by source, for each method and device."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.4, 4.4), layout="constrained")
        panels = figure.subplots(1, len(METHODS), sharey=True)
        sources = list(dict.fromkeys(s for c in found.values() for m in METHODS for s in c.statements[m].by_source))
        sources = [s for s in sources if max(_share(c, m, s).max() for c in found.values() for m in METHODS) > 0.01]
        place = np.arange(len(sources))
        for axes, method in zip(panels, METHODS, strict=True):
            for k, (c, colour) in enumerate(zip(found.values(), (BLUE, ORANGE), strict=True)):
                width = [_share(c, method, source).max() for source in sources]
                axes.barh(place - 0.2 + 0.4 * k, width, height=0.38, color=colour, label=c.device.name)
            axes.set(title=f"Method {method}", xlabel="largest u / %")
            axes.set_yticks(place, sources)
            axes.grid(visible=False, axis="y")
        panels[0].invert_yaxis()
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _share(c: Comparison, method: int, source: str) -> Array:
    """(3,) u of the main sensitivities from one source, in %."""
    u = c.statements[method].by_source.get(source, np.zeros(12))
    return np.asarray(np.nan_to_num(u[MAIN]) / np.abs(c.main[method]) * 100)


def per_mps2(device: Device) -> str:
    """Unit of S: mV per m/s2, or none where the output is in m/s2 itself."""
    return "mV/(m/s²)" if device.unit == "mV" else "(m/s²)/(m/s²)"
