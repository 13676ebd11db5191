"""Style of the figures: narrow enough for a phone, with the same colours on screen (light and dark) and on paper."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agent.config.whole_files import whole_file, write_whole

WIDTH_IN = 5.0  # 480 px: on a phone of 360 px the 10 pt letters are still 9 px high
ABOVE: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.0}  # of a legend, over the axes
INK, PALE, PAPER = "#1b1e23", "#c9ced6", "#ffffff"
USED, REFUSED = "#2a7f62", "#b3431b"
HELD = "#b58b00"  # one of the shades
AXIS_COLOURS = ("#0068b5", "#c2500a", "#00805e")  # x, y, z; colour-blind people can distinguish them too
RESULT_COLOURS = ("#0068b5", "#c2500a", "#00805e", "#8f4f9f", "#7a6a00", "#5a6472")
RESULT_MARKERS = "osD^vP"
SHADES = ("#0068b5", "#c2500a", "#00805e", "#8f4f9f", "#b58b00", "#4aa3d8", "#d87a9b", "#7a8796")
_SETTINGS: Any = {
    "font.family": "DejaVu Sans",  # part of matplotlib
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.labelsize": 10,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": PALE,
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "date.converter": "concise",
    "lines.linewidth": 1.2,
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    "savefig.facecolor": PAPER,
    "svg.hashsalt": "fieldcal",  # the same report gives the same bytes
}
# Colours that the page changes for dark screens, with the name of their CSS property.
_VARIABLES = {INK: "--ink", PALE: "--pale", PAPER: "--paper"} | {
    colour: f"--series-{i}" for i, colour in enumerate((*SHADES, USED, REFUSED))
}


@contextmanager
def drawing() -> Iterator[None]:
    """Context in which figures are made and saved with this style."""
    with matplotlib.rc_context(_SETTINGS):
        yield


def figure(height_in: float) -> Figure:
    """An empty figure, laid out so that nothing overlaps."""
    return Figure(figsize=(WIDTH_IN, height_in), layout="constrained")


def save(drawn: Figure, directory: Path, name: str) -> str:
    """Write NAME.svg, .png and .pdf; gives the SVG for the page, with its own ids. Raises OSError."""
    text = svg(drawn)
    write_whole(directory / f"{name}.svg", text.encode())
    with whole_file(directory / f"{name}.png") as file:
        drawn.savefig(file, format="png", dpi=160)
    with whole_file(directory / f"{name}.pdf") as file:
        drawn.savefig(file, format="pdf", metadata={"CreationDate": None})
    return _inline(text, name)


def svg(drawn: Figure) -> str:
    """The figure as the text of an SVG file."""
    drawn.draw_without_rendering()
    drawn.set_layout_engine("none")  # the layout is computed once, not for each format
    buffer = io.StringIO()
    drawn.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _inline(text: str, name: str) -> str:
    """The svg element only, with colours from the page and with ids that no other figure of the page has."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<svg [^>]*?>", lambda m: re.sub(r' (width|height)="[^"]*"', "", m[0]), text, count=1)
    text = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{name}-", text)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, f"var({variable})")
    return text


def bare(axes: Axes) -> None:
    """Switch off the grid along y, because the rows are names."""
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)


def series(k: int) -> dict[str, Any]:
    """Style of the axis `k` of the sensor with its uncertainty; the marker tells it apart without colours too."""
    return {"color": AXIS_COLOURS[k], "marker": "osD"[k], "markersize": 4, "capsize": 3, "label": "xyz"[k]}
