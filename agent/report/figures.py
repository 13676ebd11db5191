"""Makes and saves all figures of a report."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from agent.report import diagrams, frequencies, signals, style, timelines
from agent.report.material import Material
from agent.report.trace import Residuals
from agent.report.units import position_name


@dataclass(frozen=True, slots=True)
class DrawnFigure:
    """A figure that was saved as `name`.svg, .png and .pdf; `svg` is for the page."""

    name: str
    caption: str
    svg: str


def draw(material: Material, shown: Residuals | None, directory: Path) -> list[DrawnFigure]:
    """Save all figures for which the material has data. Raises OSError."""
    directory.mkdir(parents=True, exist_ok=True)
    with style.drawing():
        return [
            DrawnFigure(name, caption, style.save(figure, directory, name))
            for name, caption, figure in _figures(material, shown)
            if figure is not None
        ]


def _figures(material: Material, shown: Residuals | None) -> Iterator[tuple[str, str, Figure | None]]:
    results, unit = [r.in_display_units for r in material.results], material.results[0].unit
    several = len(results) > 1
    named = [(f"-{k + 1}" if several else "", f", {r.label}" if several else "", r) for k, r in enumerate(results)]
    for number, about, result in named:
        caption = f"Rows of S as points{about}; without transverse sensitivities each point is on its axis."
        yield f"rows{number}", caption, diagrams.rows_in_space(result)
    yield "main", "Main sensitivities with their expanded uncertainties.", diagrams.main_sensitivities(results)
    caption = "Transverse sensitivities in percent of the main one of their row, with expanded uncertainties."
    yield "transverse", caption, diagrams.transverse_sensitivities(results)
    for number, about, result in named:
        caption = f"Main sensitivities over frequency, relative to S, with expanded uncertainties{about}."
        caption += " Dotted: the frequency at which S holds. Shaded: where S alone is right within a third of U."
        yield f"response{number}", caption, frequencies.response(result)
    if shown is not None:
        model = f" of {results[0].label}" if several else ""
        where = f"position {position_name(shown.position)}, {shown.time_s[0]:.1f} to {shown.time_s[-1]:.1f} s"
        caption = f"Indications (points) against S a + Q{model} (line): some cycles of the window in {where}."
        yield "indications", caption, signals.indications(shown, unit)
        caption = f"Residuals: indications minus S a + Q{model}, window in {where}."
        if results[0].fields.get("nuisances"):
            caption += (
                " Poses are taken as stated, so errors that the adjustment assigned "
                "to nuisances are still in the residuals."
            )
        if shown.frequency_hz:
            caption += f" Dotted: mean frequency of the motion, {shown.frequency_hz:.3g} Hz."
        yield "residuals", caption, signals.left_over(shown, unit)
    for number, about, result in named:
        caption = f"Uncertainty budget: share of each source in the variance{about}."
        yield f"budget{number}", caption, timelines.budget(result)
        yield f"windows{number}", f"Windows and their verdicts{about}.", timelines.windows(result.windows)
    caption = "History of the calibrations, with expanded uncertainties."
    yield "history", caption, timelines.history(material.history, unit)
